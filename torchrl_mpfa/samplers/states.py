"""States of samplers: a twin loads them, and takes the sampler's place once that has gone well."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_mpfa.checks import NOT_NEGATIVE, check, check_not_negative
from torchrl_mpfa.samplers.trees import is_learned
from torchrl_mpfa.saving import check_saved, dump, open_dump

FORMAT = 5
"""Version of saved states."""


class SavedSampler:
    """The part of a sampler that saves and loads: tensors and plain values only.

    A subclass names its attributes in ``SAVED``, and overrides :meth:`_restore` where a loaded
    value is to be checked or anything follows from it.
    """

    KIND: str
    """Kind of sampler that a saved state must be of."""
    SAVED: tuple[str, ...] = ()
    """Attributes that are saved as they are."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next batches depend on but for the generator, on the CPU."""
        attributes = {name: getattr(self, name) for name in self.SAVED}
        copies = {
            k: v.to("cpu", copy=True) if isinstance(v, Tensor) else v for k, v in attributes.items()
        }
        return {"_format": FORMAT, "_kind": self.KIND, **copies}

    @torch.inference_mode(False)
    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state of a sampler of the same kind and size, on any device.

        Raises:
            KeyError: If an entry is missing; nothing is changed.
            ValueError: If format, kind or a size differs, or a number is not finite; nothing is
                changed.
        """
        check_saved("sampler", state_dict, self.SAVED, _format=FORMAT, _kind=self.KIND)
        twin = object.__new__(type(self))
        vars(twin).update(vars(self))
        twin._restore(state_dict)
        self._take(twin)

    def _take(self, twin: Any) -> None:
        """Take over what a twin has loaded."""
        vars(self).update(vars(twin))

    def _restore(self, state: dict[str, Any]) -> None:
        """Load a state, without writing in any tensor: this is the twin, which shares them."""
        for name in self.SAVED:
            setattr(self, name, alike(name, state[name], getattr(self, name)))

    def dumps(self, path: str | Path) -> None:
        """Save the state in a folder."""
        dump(self.state_dict(), path)

    def loads(self, path: str | Path) -> None:
        """Restore the state from a folder, or raise as :meth:`load_state_dict`."""
        self.load_state_dict(open_dump(path))


class SavedTrees(SavedSampler, PrioritizedSampler):
    """The part of :class:`~torchrl_mpfa.samplers.TreeSampler` that saves and loads."""

    KIND = "proportional"
    SAVED: tuple[str, ...] = ("_alpha", "_beta", "_eps", "_highest", "_highest_slot")
    _alpha: float
    _beta: float
    trees: Any

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next batches depend on but for the generator, on the CPU.

        ``_learned`` is true where a priority was learned. Leaves, ``_sum_tree``, are -0.0 where a
        slot cannot be sampled.
        """
        slots = torch.arange(self._max_capacity, device=self.device)
        kept = self.trees.priorities
        return {
            **super().state_dict(),
            "_schema_version": self._STATE_SCHEMA_VERSION,
            "_max_capacity": self._max_capacity,
            "_priorities": kept.abs().cpu(),
            "_learned": is_learned(kept).cpu(),
            "_sum_tree": self.trees.leaves(slots).cpu(),
        }

    def _restore(self, state: dict[str, Any]) -> None:
        names, size = ("_priorities", "_learned", "_sum_tree"), self._max_capacity
        check_saved("sampler", state, names, _max_capacity=size)
        self._init()
        super()._restore(state)
        check(NOT_NEGATIVE, alpha=self._alpha, beta=self._beta, eps=self._eps)
        kept = self.trees.priorities
        priorities, leaves = (
            alike(name, state[name], kept) for name in ("_priorities", "_sum_tree")
        )
        learned = alike("_learned", state["_learned"], kept.isnan())
        # NaN where nothing was written, and there trees are left as they are made.
        slots = (~priorities.isnan()).nonzero().squeeze(1)
        priorities, leaves = priorities[slots], leaves[slots]
        check_not_negative("'_priorities' of the saved sampler", priorities)
        check_not_negative("'_sum_tree' of the saved sampler", leaves)
        if len(slots):
            signed = torch.where(learned[slots], priorities, -priorities)
            self.trees.put(slots, leaves, signed)
        if not bool(self.trees.sum(size) < math.inf):
            raise ValueError("'_sum_tree' of the saved sampler must have a finite sum, got inf")


def alike(name: str, saved: Any, own: Any) -> Any:
    """Return a copy of a saved value, which must have the type and size of a sampler's own."""
    if not isinstance(own, Tensor):
        if isinstance(saved, Tensor):
            raise ValueError(f"{name!r} of the saved sampler must be a plain value, got {saved}")
        return saved
    # A tensor that is empty at first may have any length.
    matches = isinstance(saved, Tensor) and saved.dtype is own.dtype and saved.ndim == own.ndim
    if not matches or (len(own) and saved.shape != own.shape):
        form = f"{saved.dtype} of shape {[*saved.shape]}" if isinstance(saved, Tensor) else saved
        wanted = f"{own.dtype} of shape {[*own.shape]}"
        raise ValueError(f"{name!r} of the saved sampler must be {wanted}, got {form}")
    return saved.to(own.device, copy=True)
