"""States of samplers: a twin loads them, and takes the sampler's place once that has gone well."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_mpfa.checks import NOT_NEGATIVE, check, check_not_negative
from torchrl_mpfa.samplers.trees import leaves_of, set_leaves
from torchrl_mpfa.saving import check_saved, dump, open_dump

FORMAT = 4
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
    SAVED: tuple[str, ...] = ("_alpha", "_beta", "_eps", "_highest", "_highest_slot", "_priorities")
    _alpha: float
    _beta: float
    _sum_tree: Any
    _apart: Any

    @property
    def _priorities(self) -> Tensor:
        """Priorities, eps included and before alpha, NaN where nothing was written, ``[N]``."""
        # Beside compiled trees they are in one tensor, of which a pickle would copy a view apart.
        return self._sum_tree.priorities if self._apart is None else self._apart

    @_priorities.setter
    def _priorities(self, value: Tensor) -> None:
        self._priorities.copy_(value)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next batches depend on but for the generator, on the CPU."""
        slots = torch.arange(self._max_capacity, device=self.device)
        leaves = {
            name: leaves_of(getattr(self, name), slots).cpu() for name in ("_sum_tree", "_min_tree")
        }
        return {
            **super().state_dict(),
            "_schema_version": self._STATE_SCHEMA_VERSION,
            "_max_capacity": self._max_capacity,
            "_learned": leaves_of(self._max_tree, slots).cpu() <= 0,
            **leaves,
        }

    def _restore(self, state: dict[str, Any]) -> None:
        names, size = ("_learned", "_sum_tree", "_min_tree"), self._max_capacity
        check_saved("sampler", state, names, _max_capacity=size)
        self._init()
        super()._restore(state)
        check(NOT_NEGATIVE, alpha=self._alpha, beta=self._beta, eps=self._eps)
        # NaN where nothing was written, and there trees are left as they are made.
        slots = (~self._priorities.isnan()).nonzero().squeeze(1)
        check_not_negative("'_priorities' of the saved sampler", self._priorities[slots])
        learned = alike("_learned", state["_learned"], self._priorities.isnan())[slots]
        for name in ("_sum_tree", "_min_tree"):
            leaf = alike(name, state[name], self._priorities)[slots]
            # A leaf of what cannot be sampled is infinite among the lowest.
            check_not_negative(f"{name!r} of the saved sampler", leaf.where(leaf != math.inf, 0.0))
            if len(slots):
                set_leaves(slots, leaf, getattr(self, name))
        if not bool(self._sum_tree.query(0, size) < math.inf):
            raise ValueError("'_sum_tree' of the saved sampler must have a finite sum, got inf")
        if bool(learned.any()):
            slots = slots[learned]
            set_leaves(slots, -self._priorities[slots], self._max_tree)


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
