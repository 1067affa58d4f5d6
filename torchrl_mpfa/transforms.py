"""Memory of a buffer's transforms from one write to the next: restored, saved and emptied."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs.transforms import Compose, MultiStepTransform, Transform

from torchrl_mpfa.checks import as_mask
from torchrl_mpfa.storages.schema import Schema, as_path

KEPT = "_kept"
"""Entry of a saved buffer with the memory of its transforms."""
_AT_A_WRITE = ("inv", "_inv_call", "_inv_apply_transform")
_OF_EVERY_MODULE = {*vars(nn.Module())}
_LISTS: dict[str, type] = {"list": list, "tuple": tuple, "deque": deque}
_Attributes = dict[str, Any]


class TransformMemory:
    """Attributes that writes change: transitions that transforms keep, numbers, texts.

    Tensors, tensordicts, lists and mappings of these count as changed by each write. The content of
    a tuple is never written in place: it is not copied before each write.

    Args:
        transform: The transforms of a buffer.
        allow_nonfinite: Entries of transitions that may hold NaN and infinities.
    """

    def __init__(self, transform: Compose, allow_nonfinite: Sequence[NestedKey]) -> None:
        self._transform, self._allowed = transform, allow_nonfinite
        # By module, the values of its attributes before the first write that changed them.
        self._first: dict[nn.Module, _Attributes] = {}

    def parts(self) -> dict[str, nn.Module]:
        """Return the transforms that run at a write, and the modules in them, by name."""
        return {
            f"{place}.{name}": module
            for place, each in enumerate(self._transform)
            if _writes(each)
            for name, module in each.named_modules()
        }

    @contextmanager
    def transformed(self, data: TensorDictBase) -> Iterator[TensorDictBase | None]:
        """Yield transitions as the transforms make them.

        Attributes and random numbers are set back if anything raises inside of this.
        """
        parts = [*self.parts().values()]
        if not parts:
            yield self._transform.inv(data)
            return
        for part in parts:
            if part not in self._first:
                _warn_of_steps_past_the_end(part)
        before = [_attributes(part) for part in parts]
        copies, random = [*map(_copied, before)], torch.get_rng_state()
        sources = [v for own in before for v in own.values() if isinstance(v, torch.Generator)]
        states = [source.get_state() for source in sources]
        try:
            # A copy: the caller may write into its own again.
            made = self._transform.inv(_with_masks(data.clone(), parts))
            for part, own, copy in zip(parts, before, copies, strict=True):
                self._check_kept(part, own, copy)
            yield made
        except BaseException:
            for part, copy in zip(parts, copies, strict=True):
                _replace(part, copy)
            torch.set_rng_state(random)
            for source, state in zip(sources, states, strict=True):
                source.set_state(state)
            raise
        for part, own, copy in zip(parts, before, copies, strict=True):
            self._record(part, own, copy)

    def _check_kept(self, part: nn.Module, before: _Attributes, copy: _Attributes) -> None:
        """Reject transitions that a part keeps since a write."""
        for name, value in _attributes(part).items():
            if _holds(value):
                known = before.get(name) if isinstance(value, tuple) else None
                self._check(value, next(_rows(copy.get(name)), None), {*map(id, _rows(known))})

    def _record(self, part: nn.Module, before: _Attributes, copy: _Attributes) -> None:
        """Record the attributes that a write has changed, with their values before it."""
        first = self._first.setdefault(part, {})
        for name, value in _attributes(part).items():
            if _holds(value) or (_is_plain(value) and value is not before.get(name)):
                first.setdefault(name, copy.get(name))

    def _check(self, value: Any, like: TensorDictBase | None, known: set[int]) -> None:
        """Reject kept transitions that are not finite, or unlike those before them."""
        for rows in _rows(value):
            if id(rows) not in known:
                schema = Schema(rows if like is None else like, rows.ndim, self._allowed)
                schema.check(rows, rows.ndim, whole=True)

    def empty(self) -> None:
        """Give attributes the values that they had before any write."""
        for part in self.parts().values():
            _replace(part, _attributes(part) | _copied(self._first.get(part, {})))

    def state_dict(self) -> dict[str, Any]:
        """Return the attributes that writes changed, as tensors and plain values."""
        return {
            name: {key: _packed(_attributes(part)[key]) for key in self._first[part]}
            for name, part in self.parts().items()
            if part in self._first
        }

    def load_state_dict(self, state: Any) -> None:
        """Restore the memory of the same transforms.

        Raises:
            ValueError: If the state is of other transforms, or a saved transition is not finite.
        """
        parts = self.parts()
        self.empty()
        for name, saved in state.items() if isinstance(state, Mapping) else [("", state)]:
            own = _attributes(parts[name]) if name in parts else {}
            if not isinstance(saved, Mapping) or not saved.keys() <= own.keys():
                raise ValueError(
                    f"{KEPT!r} of the saved buffer must be of transforms {[*parts]}, got {name!r}"
                )
            found = {key: _unpacked(value) for key, value in saved.items()}
            for value in found.values():
                self._check(value, None, set())
            self._first[parts[name]] = _copied({key: own[key] for key in found}) | self._first.get(
                parts[name], {}
            )
            _replace(parts[name], own | found)


def _warn_of_steps_past_the_end(part: nn.Module) -> None:
    """Warn of n-step transitions that do not know that their last step ended the episode."""
    if not isinstance(part, MultiStepTransform) or part.n_steps == 1:
        return
    if any(as_path(key)[-1] == "terminated" for key in part.done_keys):
        warnings.warn(
            f"MultiStepTransform with done_keys={part.done_keys} leaves 'terminated' where it was, "
            "while the next observation moves n steps on: targets are bootstrapped past the end of "
            "an episode. Set done_keys=['done']",
            stacklevel=4,
        )


def _writes(transform: nn.Module) -> bool:
    """Return True if a transform does anything when transitions are written."""
    if isinstance(transform, Compose):
        return any(_writes(each) for each in transform)
    own = any(getattr(type(transform), n, None) is not getattr(Transform, n) for n in _AT_A_WRITE)
    return own or bool(getattr(transform, "in_keys_inv", ()))


def _with_masks(data: Any, parts: Sequence[nn.Module]) -> Any:
    """Return transitions with booleans for masks that a transform of several steps reads."""
    for part in parts:
        if isinstance(part, MultiStepTransform):
            for key in (("next", part.done_key), part.mask_key):
                if (mask := data.get(key, None)) is not None:
                    data.set(key, as_mask(repr(key), mask))
    return data


def _attributes(part: nn.Module) -> _Attributes:
    own = {name: each for name, each in vars(part).items() if name not in _OF_EVERY_MODULE}
    return {**own, **part._buffers}


def _replace(part: nn.Module, attributes: _Attributes) -> None:
    for name in _attributes(part).keys() - attributes.keys():
        delattr(part, name)
    for name, value in attributes.items():
        (part._buffers if name in part._buffers else vars(part))[name] = value


def _is_plain(value: Any) -> bool:
    return value is None or isinstance(value, bool | int | float | str)


def _holds(value: Any) -> bool:
    """Return True if a value is of tensors and tensordicts only."""
    if isinstance(value, list | tuple | deque | dict):
        return all(_holds(each) for each in (value.values() if type(value) is dict else value))
    return isinstance(value, Tensor | TensorDictBase)


def _rows(value: Any) -> Iterator[TensorDictBase]:
    """Yield the tensordicts in a value."""
    if isinstance(value, TensorDictBase):
        yield value
    elif isinstance(value, list | tuple | deque | dict):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _rows(each)


def _copied(value: Any) -> Any:
    """Return a copy of the tensors, lists and mappings in a value; tuples stay as they are."""
    if isinstance(value, Tensor | TensorDictBase):
        return value.clone()
    if type(value) is dict:
        return {key: _copied(each) for key, each in value.items()}
    if isinstance(value, deque):
        return deque(map(_copied, value), value.maxlen)
    return [*map(_copied, value)] if type(value) is list else value


def _packed(value: Any) -> Any:
    """Return a value in a form that can be read without executing anything."""
    if isinstance(value, TensorDictBase):
        rows = {key: each.clone() for key, each in value.items(True, True)}
        return {"rows": rows, "size": [*value.batch_size]}
    if type(value) is dict:
        return {"dict": {key: _packed(each) for key, each in value.items()}}
    if (kind := type(value).__name__) in _LISTS:
        return {kind: [*map(_packed, value)], "maxlen": getattr(value, "maxlen", None)}
    return value.clone() if isinstance(value, Tensor) else value


def _unpacked(value: Any) -> Any:
    """Return a value as it was before :func:`_packed`."""
    if not isinstance(value, Mapping):
        return value.clone() if isinstance(value, Tensor) else value
    kind, content = next(iter(value.items()))
    if kind == "rows":
        return TensorDict(dict(content), value["size"]).clone()
    if kind == "dict":
        return {key: _unpacked(each) for key, each in content.items()}
    made = [_unpacked(each) for each in content]
    return deque(made, value["maxlen"]) if kind == "deque" else _LISTS[kind](made)
