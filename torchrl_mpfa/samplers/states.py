"""Saving and loading of a sampler; a state that does not fit is refused before it is loaded."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_mpfa.saving import load_safely, save_atomically

FORMAT = 2


class SavedTrees(PrioritizedSampler):
    """The part of :class:`~torchrl_mpfa.TreeSampler` that saves and loads."""

    KIND = "proportional"
    """What a saved state must have been made by."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next batches depend on; tensors and plain values only."""
        slots = torch.arange(self._max_capacity)
        return {
            "_schema_version": self._STATE_SCHEMA_VERSION,
            "_format": FORMAT,
            "_kind": self.KIND,
            "_max_capacity": self._max_capacity,
            "_alpha": float(self._alpha),
            "_beta": float(self._beta),
            "_eps": float(self._eps),
            "_highest": self._highest,
            "_highest_slot": self._highest_slot,
            "_priorities": self._priorities.clone(),
            "_learned": torch.as_tensor(self._max_tree[slots]).reshape(-1) <= 0,
            "_sum_tree": torch.as_tensor(self._sum_tree[slots]).reshape(-1).clone(),
            "_min_tree": torch.as_tensor(self._min_tree[slots]).reshape(-1).clone(),
        }

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Refuse a state that does not fit, before anything changes.

        Raises:
            ValueError: If an entry is missing, of another sampler, or not what it must be.
        """
        check_tree_state(state_dict, kind=self.KIND, capacity=self._max_capacity)
        written = ~state_dict["_priorities"].isnan()
        check_leaves(state_dict, written, self._saved_leaves(state_dict, written))

    def _saved_leaves(self, state: Mapping[str, Any], written: Tensor) -> Tensor:
        """What written slots of a saved state are sampled in proportion to, shape ``[M]``."""
        priorities: Tensor = state["_priorities"][written]
        return priorities.pow(state["_alpha"])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Raises:
            ValueError: See :meth:`check_state`.
        """
        self.check_state(state_dict)
        self._init()
        self._alpha = state_dict["_alpha"]
        self._beta = state_dict["_beta"]
        self._eps = state_dict["_eps"]
        self._highest = state_dict["_highest"]
        self._highest_slot = state_dict["_highest_slot"]
        self._priorities.copy_(state_dict["_priorities"])
        # Leaves that were never written hold what the tree takes for nothing; only the others
        # are written back, and inner nodes follow from the leaves alone.
        slots = self._priorities.isfinite().nonzero().squeeze(1)
        if len(slots):
            for name in ("_sum_tree", "_min_tree"):
                getattr(self, name)[slots] = state_dict[name][slots]
        learned = (state_dict["_learned"] & self._priorities.isfinite()).nonzero().squeeze(1)
        if len(learned):
            self._max_tree[learned] = -self._priorities[learned]

    def dumps(self, path: str | Path) -> None:
        """Save in a folder: everything in one file, and beside it what a person can read."""
        path = Path(path).absolute()
        path.mkdir(exist_ok=True)
        state = self.state_dict()
        save_atomically(state, path / "sampler.pt")
        plain = {key: value for key, value in state.items() if not isinstance(value, Tensor)}
        text = json.dumps(plain, indent=2, default=lambda value: f"{[*value.shape]} numbers")
        (path / "sampler_metadata.json").write_text(text, encoding="utf-8")

    def check_dump(self, path: str | Path) -> dict[str, Any]:
        """Read a saved sampler and refuse it as :meth:`check_state` does."""
        state: dict[str, Any] = load_safely(Path(path) / "sampler.pt")
        self.check_state(state)
        return state

    def loads(self, path: str | Path) -> None:
        """Restore from a folder.

        Raises:
            ValueError: See :meth:`check_state`.
        """
        self.load_state_dict(self.check_dump(path))


def check_tree_state(state: Mapping[str, Any], *, kind: str, capacity: int) -> None:
    """Refuse a state that is not that of such a sampler.

    Args:
        state: The saved state.
        kind: Kind of the sampler that is to load it.
        capacity: Its capacity ``N``.

    Raises:
        ValueError: If an entry is missing, of another sampler, or not what it must be.
    """
    if not isinstance(state, Mapping):
        raise ValueError(f"the saved sampler must be a mapping, got {type(state).__name__}")
    if (found := state.get("_format")) != FORMAT:
        raise ValueError(f"format of the saved sampler is {found}, this version has {FORMAT}")
    if (found := entry(state, "_kind")) != kind:
        raise ValueError(f"the saved sampler is {found!r}, this one {kind!r}")
    if (found := entry(state, "_max_capacity")) != capacity:
        raise ValueError(f"max_capacity of the saved sampler is {found}, of this one {capacity}")
    for name in ("_alpha", "_beta", "_eps"):
        check_number(state, name)
    if entry(state, "_highest") is not None:
        check_number(state, "_highest")
    slot = entry(state, "_highest_slot")
    if slot is not None and not (isinstance(slot, int) and 0 <= slot < capacity):
        refuse("_highest_slot", f"a slot in [0, {capacity})", slot)
    priorities = check_tensor(state, "_priorities", torch.double, capacity)
    written = ~priorities.isnan()
    check_values(state, "_priorities", written, high=math.inf)
    learned = check_tensor(state, "_learned", torch.bool, capacity)
    if bool((learned & ~written).any()):
        refuse("_learned", "false where nothing was written", True)
    for name in ("_sum_tree", "_min_tree"):
        check_tensor(state, name, torch.double, capacity)


def check_leaves(state: Mapping[str, Any], written: Tensor, leaves: Tensor) -> None:
    """Refuse trees that do not belong to their priorities.

    Args:
        state: The saved state.
        written: Which slots are written, shape ``[N]``.
        leaves: What follows from the priorities of those, shape ``[M]``; 0 where a slot is left
            out of the sampling, and has no lowest share either.

    Raises:
        ValueError: If they do not, or have no finite sum.
    """
    for name, counts in (("_sum_tree", leaves >= 0), ("_min_tree", leaves > 0)):
        found = state[name][written]
        # The power of a number may differ in its last bits by what stands beside it.
        wrong = counts & ~found.isclose(leaves, rtol=1e-9, atol=0.0) | ~(found >= 0)
        if bool(wrong.any()):
            wanted = f"{leaves[wrong][0].item()}, as follows from '_priorities'"
            refuse(name, wanted, found[wrong][0].item())
    if not bool(leaves.sum() < math.inf):
        refuse("_sum_tree", "of finite sum", math.inf)


def entry(state: Mapping[str, Any], name: str) -> Any:
    """An entry of the state, which must be there."""
    if name not in state:
        raise ValueError(f"{name!r} is missing in the saved sampler")
    return state[name]


def check_number(state: Mapping[str, Any], name: str) -> None:
    """Refuse what is not a finite number of at least zero."""
    value = entry(state, name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < math.inf:
        refuse(name, "a finite number of at least 0", value)


def check_count(state: Mapping[str, Any], name: str) -> None:
    """Refuse what is not an integer of at least zero."""
    value = entry(state, name)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        refuse(name, "an integer of at least 0", value)


def check_tensor(
    state: Mapping[str, Any], name: str, dtype: torch.dtype, length: int | None
) -> Tensor:
    """An entry that must be a tensor of one dimension, and of this length if one is given."""
    value = entry(state, name)
    if not isinstance(value, Tensor):
        refuse(name, "a tensor", value)
    fits = value.ndim == 1 and value.dtype is dtype and length in (None, len(value))
    if not fits:
        wanted = f"{dtype} of shape [{'M' if length is None else length}]"
        refuse(name, wanted, f"{value.dtype} of shape {[*value.shape]}")
    return value


def check_values(state: Mapping[str, Any], name: str, where: Tensor, *, high: float) -> None:
    """Refuse values that are negative, not a number, or not below a bound."""
    values = state[name][where]
    wrong = ~((values >= 0) & (values < high))
    if bool(wrong.any()):
        refuse(name, "finite and not negative", values[wrong][0].item())


def refuse(name: str, wanted: str, found: object) -> NoReturn:
    """Raise the error of an entry that is not what it must be."""
    raise ValueError(f"{name!r} of the saved sampler must be {wanted}, got {found!r}")
