"""What a buffer's transforms keep from one write to the next: set back, and emptied."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from types import MappingProxyType
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.utils._pytree import tree_leaves
from torchrl.envs.transforms import Compose, MultiStepTransform, Transform

from torchrl_mpfa.checks import as_mask
from torchrl_mpfa.storages.entries import as_path, check_finite_entries

_AT_A_WRITE = ("inv", "_inv_call", "_inv_apply_transform")
_OF_EVERY_MODULE = {*vars(nn.Module())}
_Attributes = dict[str, Any]


class TransformMemory:
    """Attributes of a buffer's transforms, which a write that is rejected leaves as they were.

    What is to be saved, a transform hands on by PyTorch's ``get_extra_state``, as
    :class:`~torchrl_mpfa.methods.her.HindsightGoals` does. The steps that wait in TorchRL's n-step
    transform are lost at a load, and no others join what was loaded.

    Args:
        transform: The transforms of a buffer.
        allow_nonfinite: Entries of transitions that may hold NaN and infinities.
    """

    def __init__(self, transform: Compose, allow_nonfinite: Sequence[NestedKey]) -> None:
        self._transform, self._allowed = transform, allow_nonfinite
        # By module, the values of its attributes before the first write that changed them.
        self._first: dict[nn.Module, _Attributes] = {}

    def parts(self) -> list[nn.Module]:
        """Return the transforms that run at a write, and the modules in them."""
        writing = [transform for transform in self._transform if _writes(transform)]
        return [module for transform in writing for module in transform.modules()]

    @contextmanager
    def kept(self) -> Iterator[dict[nn.Module, _Attributes]]:
        """Set attributes and random numbers back if anything raises inside of this.

        Yields:
            By module, copies of its attributes.
        """
        copies = {part: _copied(_attributes(part)) for part in self.parts()}
        values = [value for attributes in copies.values() for value in attributes.values()]
        sources = [torch.default_generator, *values]
        states = [(s, s.get_state()) for s in sources if isinstance(s, torch.Generator)]
        try:
            yield copies
        except BaseException:
            _set_back(copies)
            for source, state in states:
                source.set_state(state)
            raise

    @contextmanager
    def transformed(self, data: TensorDictBase) -> Iterator[TensorDictBase | None]:
        """Yield transitions as the transforms make them; see :meth:`kept`."""
        parts = self.parts()
        if not parts:
            yield self._transform.inv(data)
            return
        for part in parts:
            if part not in self._first:
                _warn_of_steps_past_the_end(part)
                self._first[part] = {}
        with self.kept() as copies:
            # A copy: the caller may write into its own again.
            rows = self._transform.inv(_with_masks(data.clone(), parts))
            self.check_finite(copies)
            yield rows
        for part, name, _ in self._changes(copies):
            self._first[part].setdefault(name, copies[part].get(name))

    def check_finite(self, since: Mapping[nn.Module, _Attributes] = MappingProxyType({})) -> None:
        """Reject a number that is not finite in the steps that wait, or do so since a copy."""
        for _, _, value in self._changes(since):
            for waiting in tree_leaves(value, lambda v: isinstance(v, TensorDictBase)):
                if isinstance(waiting, TensorDictBase):
                    check_finite_entries(waiting, waiting.ndim, self._allowed)

    def _changes(
        self, since: Mapping[nn.Module, _Attributes]
    ) -> Iterator[tuple[nn.Module, str, Any]]:
        """Yield what has changed, or may have in its place: module, name and value."""
        for part in self.parts():
            before = since.get(part, {})
            for name, value in _attributes(part).items():
                if name not in before or value is not before[name]:
                    yield part, name, value

    def empty(self) -> None:
        """Give attributes the values that they had before any write."""
        first = self._first.items()
        _set_back({part: _attributes(part) | _copied(values) for part, values in first})


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
        return any(_writes(part) for part in transform)
    overrides = any(
        getattr(type(transform), n, None) is not getattr(Transform, n) for n in _AT_A_WRITE
    )
    return overrides or bool(getattr(transform, "in_keys_inv", ()))


def _with_masks(data: Any, parts: Sequence[nn.Module]) -> Any:
    """Return transitions with booleans for masks that a transform of several steps reads."""
    for part in parts:
        if isinstance(part, MultiStepTransform):
            for key in (("next", part.done_key), part.mask_key):
                if (mask := data.get(key, None)) is not None:
                    data.set(key, as_mask(repr(key), mask))
    return data


def _attributes(part: nn.Module) -> _Attributes:
    attributes = {name: value for name, value in vars(part).items() if name not in _OF_EVERY_MODULE}
    return {**attributes, **part._buffers}


def _set_back(copies: dict[nn.Module, _Attributes]) -> None:
    """Give modules the attributes that they had when these were copied."""
    for part, attributes in copies.items():
        for name in _attributes(part).keys() - attributes.keys():
            delattr(part, name)
        for name, value in attributes.items():
            (part._buffers if name in part._buffers else vars(part))[name] = value


def _copied(attributes: _Attributes) -> _Attributes:
    """Return attributes with copies of what a write may change in its place."""
    copies = dict(attributes)
    for name, value in attributes.items():
        if isinstance(value, Tensor | TensorDictBase):
            copies[name] = value.clone()
        elif isinstance(value, list | deque | dict):
            copies[name] = copy(value)
    return copies
