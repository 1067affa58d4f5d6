"""What the transforms of a buffer keep from one write to the next: set back, saved and emptied."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs.transforms import Compose, MultiStepTransform, Transform

from torchrl_mpfa.checks import as_mask
from torchrl_mpfa.storages.schema import Schema

_AT_A_WRITE = ("inv", "_inv_call", "_inv_apply_transform")
_OF_EVERY_MODULE = {*vars(nn.Module())}
_LISTS: dict[str, type] = {"list": list, "tuple": tuple, "deque": deque}
_Attributes = dict[str, Any]


@dataclass
class _Part:
    module: nn.Module
    came: _Attributes  # With which the buffer got it.
    written: set[str]  # Names of numbers, texts and the like that a write has changed.


class TransformMemory:
    """What transforms keep in their attributes, whichever transforms they are.

    That are tensors, tensordicts, lists and mappings of these, and whatever else a write changes.
    What stands in a tuple is never written in place: it is not copied before each write.

    Args:
        transform: The transforms of a buffer.
        allow_nonfinite: Entries of transitions that may hold NaN and infinities; None: all.
    """

    def __init__(self, transform: Compose, allow_nonfinite: Sequence[NestedKey] | None) -> None:
        self._transform, self._allowed = transform, allow_nonfinite
        self._known: list[_Part] = []

    def parts(self) -> dict[str, _Part]:
        """Transforms that run at a write, and what is in them, by name."""
        found = {}
        for place, each in enumerate(self._transform):
            for name, module in each.named_modules() if _writes(each) else ():
                part = next((known for known in self._known if known.module is module), None)
                if part is None:
                    own = _attributes(module).items()
                    came = {key: _copied(v) for key, v in own if _holds(v) or _is_plain(v)}
                    part = _Part(module, came, set())
                    self._known.append(part)
                found[f"{place}.{name}"] = part
        return found

    @contextmanager
    def at_a_write(self, data: Any) -> Iterator[tuple[Any, Callable[[], None]]]:
        """What transforms may keep of transitions, and a check of what they keep.

        What they kept before is set back if anything raises inside of this.
        """
        parts = [*self.parts().values()]
        if not parts:
            yield data, lambda: None
            return
        before = [_attributes(part.module) for part in parts]
        copies, random = [*map(_copied, before)], torch.get_rng_state()
        sources = [v for own in before for v in own.values() if isinstance(v, torch.Generator)]
        states = [source.get_state() for source in sources]

        def check() -> None:
            for part, own, copy in zip(parts, before, copies, strict=True):
                now = _attributes(part.module)
                self._check(now, own, copy)
                part.written |= {name for name, v in now.items() if v is not own.get(name)}

        try:
            # The caller may write into its own again.
            given = data.clone() if isinstance(data, TensorDictBase) else data
            yield _with_masks(given, [part.module for part in parts]), check
        except BaseException:
            for part, copy in zip(parts, copies, strict=True):
                _replace(part.module, copy)
            torch.set_rng_state(random)
            for source, state in zip(sources, states, strict=True):
                source.set_state(state)
            raise

    def _check(self, now: _Attributes, before: _Attributes, copy: _Attributes) -> None:
        """Reject kept transitions that are not finite, or unlike those before them."""
        if self._allowed is None:
            return
        for name, value in now.items():
            same = before.get(name) if isinstance(value, tuple) else None
            known = {id(rows) for rows in _rows(same)}
            like = next(_rows(copy.get(name)), None)
            for rows in _rows(value):
                if id(rows) not in known:
                    schema = Schema(rows if like is None else like, rows.ndim, self._allowed)
                    schema.check(rows, rows.ndim, whole=True)

    def empty(self) -> None:
        """Have the transforms keep nothing but what they came with."""
        for part in self.parts().values():
            _begin_again(part, _kept(part))

    def _silent(self) -> dict[str, tuple[_Part, set[str]]]:
        """Transforms whose own state leaves out what they keep, and the names of that."""
        return {
            name: (part, _kept(part) - part.module._buffers.keys())
            for name, part in self.parts().items()
            if type(part.module).get_extra_state is nn.Module.get_extra_state
        }

    def state_dict(self) -> dict[str, Any]:
        """What is kept, by transform and attribute, as tensors and plain values."""
        return {
            name: {key: _packed(_attributes(part.module)[key]) for key in sorted(kept)}
            for name, (part, kept) in self._silent().items()
            if kept
        }

    def check_state(self, state: Any) -> dict[str, _Attributes]:
        """What a saved state says is kept, by transform; one that does not fit is rejected."""
        parts, found = self._silent(), {}
        for name, kept in state.items() if isinstance(state, Mapping) else [("", state)]:
            known = _attributes(parts[name][0].module) if name in parts else {}
            if not isinstance(kept, Mapping) or not kept.keys() <= known.keys():
                raise ValueError(
                    f"'_kept' of the saved buffer must be of transforms {[*parts]}, got {name!r}"
                )
            found[name] = {key: _unpacked(value) for key, value in kept.items()}
            self._check(found[name], {}, {})
        return found

    def load_state_dict(self, state: Any) -> None:
        """Keep what a state says and nothing else, or raise as :meth:`check_state` does."""
        found = self.check_state(state)
        for name, (part, kept) in self._silent().items():
            _begin_again(part, kept)
            _replace(part.module, _attributes(part.module) | found.get(name, {}))
            part.written |= found.get(name, {}).keys()


def _begin_again(part: _Part, names: set[str]) -> None:
    """Give a transform these attributes as it came with them."""
    own = {name: value for name, value in _attributes(part.module).items() if name not in names}
    _replace(part.module, own | {key: _copied(part.came[key]) for key in names & part.came.keys()})


def _writes(transform: nn.Module) -> bool:
    """Whether a transform does anything when transitions are written."""
    if isinstance(transform, Compose):
        return any(_writes(each) for each in transform)
    own = any(getattr(type(transform), n, None) is not getattr(Transform, n) for n in _AT_A_WRITE)
    return own or bool(getattr(transform, "in_keys_inv", ()))


def _with_masks(data: Any, parts: Sequence[nn.Module]) -> Any:
    """Transitions whose masks are booleans where a transform of several steps reads them."""
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


def _kept(part: _Part) -> set[str]:
    """Names of the attributes that hold transitions and the like, or that a write has changed."""
    return {
        name
        for name, value in _attributes(part.module).items()
        if _holds(value) or (name in part.written and _is_plain(value))
    }


def _is_plain(value: Any) -> bool:
    return value is None or isinstance(value, bool | int | float | str)


def _holds(value: Any) -> bool:
    """Whether a value is of tensors and tensordicts only."""
    if isinstance(value, list | tuple | deque | dict):
        return all(_holds(each) for each in (value.values() if type(value) is dict else value))
    return isinstance(value, Tensor | TensorDictBase)


def _rows(value: Any) -> Iterator[TensorDictBase]:
    """The tensordicts in a value."""
    if isinstance(value, TensorDictBase):
        yield value
    elif isinstance(value, list | tuple | deque | dict):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _rows(each)


def _copied(value: Any) -> Any:
    if isinstance(value, Tensor | TensorDictBase):
        return value.clone()
    if type(value) is dict:
        return {key: _copied(each) for key, each in value.items()}
    if isinstance(value, deque):
        return deque(map(_copied, value), value.maxlen)
    return [*map(_copied, value)] if type(value) is list else value


def _packed(value: Any) -> Any:
    """A value as what can be read without executing anything."""
    if isinstance(value, TensorDictBase):
        rows = {key: each.clone() for key, each in value.items(True, True)}
        return {"rows": rows, "size": [*value.batch_size]}
    if type(value) is dict:
        return {"dict": {key: _packed(each) for key, each in value.items()}}
    if (kind := type(value).__name__) in _LISTS:
        return {kind: [*map(_packed, value)], "maxlen": getattr(value, "maxlen", None)}
    return value.clone() if isinstance(value, Tensor) else value


def _unpacked(value: Any) -> Any:
    """A value as it was before :func:`_packed`."""
    if not isinstance(value, Mapping):
        return value.clone() if isinstance(value, Tensor) else value
    kind, content = next(iter(value.items()))
    if kind == "rows":
        return TensorDict(dict(content), value["size"]).clone()
    if kind == "dict":
        return {key: _unpacked(each) for key, each in content.items()}
    made = [_unpacked(each) for each in content]
    return deque(made, value["maxlen"]) if kind == "deque" else _LISTS[kind](made)
