"""Saving, loading and moving of a sampler; a state that does not fit is rejected beforehand."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import RandomSampler, Storage
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_mpfa.files import load_safely, save_atomically
from torchrl_mpfa.samplers.leaves import Leaves
from torchrl_mpfa.samplers.slots import leaves_of, set_leaves
from torchrl_mpfa.saved import Entry, check_entries, exactly, number, wrong

FORMAT = 2


class SavedTrees(PrioritizedSampler):
    """The part of :class:`~torchrl_mpfa.samplers.TreeSampler` that saves, loads and moves."""

    KIND = "proportional"
    """The sampler that a saved state must be of."""
    SAVED: tuple[str, ...] = (
        *("_alpha", "_beta", "_eps", "_highest", "_highest_slot", "_priorities"),
    )
    """Attributes that are saved as they are."""
    _device: torch.device | None
    _follows: bool
    """Whether the device is that of the storage, whatever it is."""

    @property
    def device(self) -> torch.device:
        """Device of priorities and sampled slots."""
        return self._device or torch.device("cpu")

    def _maybe_init_from_storage(self, storage: Storage | None) -> None:
        """Move to the device of a storage, once it is known."""
        device = getattr(storage, "device", None)
        if device == self.device or not isinstance(device, torch.device):
            return
        if not self._follows:
            raise ValueError(
                f"device must be that of the storage, {device}, or None, got {self.device}"
            )
        state, self._device = self.state_dict(), device
        self._init()
        self.load_state_dict(state)

    def _another(self, tree: Any) -> Any:
        """An empty tree of the same kind."""
        where = (self.device,) if isinstance(tree, Leaves) else ()
        return type(tree)(self._max_capacity, *where)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next batches depend on; tensors and plain values only.

        Tensors are on the CPU, so that a state loads on any device.
        """
        slots = torch.arange(self._max_capacity, device=self.device)
        return {
            "_schema_version": self._STATE_SCHEMA_VERSION,
            "_format": FORMAT,
            "_kind": self.KIND,
            "_max_capacity": self._max_capacity,
            **{name: _copy(getattr(self, name)) for name in self.SAVED},
            "_learned": leaves_of(self._max_tree, slots).cpu() <= 0,
            "_sum_tree": leaves_of(self._sum_tree, slots).cpu(),
            "_min_tree": leaves_of(self._min_tree, slots).cpu(),
        }

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Reject a state that does not fit, before anything changes.

        Raises:
            ValueError: If an entry is missing, of another sampler, or not what it must be.
        """
        check_sampler(state_dict, self._entries())
        written = ~state_dict["_priorities"].isnan()
        words = "false where nothing was written"
        check_sampler(state_dict, [Entry("_learned", lambda found: written | ~found, words)])
        _check_leaves(state_dict, written, self._saved_leaves(state_dict, written))

    def _entries(self) -> list[Entry]:
        """The entries of a saved state."""
        slots = self._max_capacity
        each_slot: dict[str, Any] = {"dtype": torch.double, "shape": (slots,)}
        return [
            exactly("_format", FORMAT, ", which this version reads"),
            exactly("_kind", self.KIND),
            exactly("_max_capacity", slots),
            *(number(name) for name in ("_alpha", "_beta", "_eps")),
            number("_highest", optional=True),
            Entry(
                "_highest_slot",
                lambda slot: slot is None or (isinstance(slot, int) and 0 <= slot < slots),
                f"a slot in [0, {slots})",
            ),
            Entry(
                "_priorities",
                lambda found: found.isnan() | ((found >= 0) & (found < math.inf)),
                "finite and not negative",
                **each_slot,
            ),
            Entry("_learned", dtype=torch.bool, shape=(slots,)),
            Entry("_sum_tree", **each_slot),
            Entry("_min_tree", **each_slot),
        ]

    def _saved_leaves(self, state: Mapping[str, Any], written: Tensor) -> Tensor:
        """Leaves that follow from the priorities of a saved state, shape ``[M]``."""
        priorities: Tensor = state["_priorities"][written]
        return priorities.pow(state["_alpha"])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave, or raise as :meth:`check_state` does."""
        self.check_state(state_dict)
        self._init()
        for name in self.SAVED:
            setattr(self, name, _copy(state_dict[name], self.device))
        # Leaves that were never written hold what the tree takes for nothing; only the others
        # are written back, and inner nodes follow from the leaves alone.
        slots = self._priorities.isfinite().nonzero().squeeze(1)
        if len(slots):
            for name in ("_sum_tree", "_min_tree"):
                leaf = state_dict[name].to(self.device)[slots]
                set_leaves(slots, leaf, getattr(self, name))
        known = state_dict["_learned"].to(self.device) & self._priorities.isfinite()
        learned = known.nonzero().squeeze(1)
        if len(learned):
            set_leaves(learned, -self._priorities[learned], self._max_tree)

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
        """Read a saved sampler and reject it as :meth:`check_state` does."""
        state: dict[str, Any] = load_safely(Path(path) / "sampler.pt")
        self.check_state(state)
        return state

    def loads(self, path: str | Path) -> None:
        """Restore from a folder, or raise as :meth:`check_state` does."""
        self.load_state_dict(self.check_dump(path))


class SavedValues(RandomSampler):
    """The part of uniform samplers that saves and loads what they adapt: plain values."""

    FILE: str
    ENTRIES: tuple[Entry, ...]
    """Each is an attribute, whose name has no underscore."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next batches depend on beside the generator; plain values only."""
        return {entry.name: getattr(self, entry.name[1:]) for entry in self.ENTRIES}

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Reject a state that does not fit, before anything changes."""
        check_sampler(state_dict, self.ENTRIES)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave, or raise as :meth:`check_state` does."""
        self.check_state(state_dict)
        for entry in self.ENTRIES:
            setattr(self, entry.name[1:], state_dict[entry.name])

    def dumps(self, path: str | Path) -> None:
        """Save in a folder."""
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / self.FILE).write_text(json.dumps(self.state_dict()), encoding="utf-8")

    def check_dump(self, path: str | Path) -> dict[str, Any]:
        """Read a saved sampler and reject it as :meth:`check_state` does."""
        found = json.loads((Path(path) / self.FILE).read_text(encoding="utf-8"))
        # A file of an earlier version has a single value without its name.
        state = found if isinstance(found, dict) else {self.ENTRIES[0].name: found}
        self.check_state(state)
        return state

    def loads(self, path: str | Path) -> None:
        """Restore from a folder, or raise as :meth:`check_state` does."""
        self.load_state_dict(self.check_dump(path))


def _copy(value: Any, device: torch.device | str = "cpu") -> Any:
    return value.to(device, copy=True) if isinstance(value, Tensor) else value


def check_sampler(state: Any, entries: Iterable[Entry]) -> None:
    """Reject the state of a sampler that is not as described."""
    check_entries("sampler", state, entries, missing=ValueError)


def _check_leaves(state: Mapping[str, Any], written: Tensor, leaves: Tensor) -> None:
    """Reject trees that do not follow from the priorities, with leaf 0 where none is sampled."""
    for name, counts in (("_sum_tree", leaves >= 0), ("_min_tree", leaves > 0)):
        found = state[name][written]
        # The power of a number may differ in its last bits by what stands beside it.
        bad = counts & ~found.isclose(leaves, rtol=1e-9, atol=0.0) | ~(found >= 0)
        if bool(bad.any()):
            wanted = f"{leaves[bad][0].item()}, as follows from '_priorities'"
            raise wrong("sampler", name, wanted, found[bad][0].item())
    if not bool(leaves.sum() < math.inf):
        raise wrong("sampler", "_sum_tree", "of finite sum", math.inf)
