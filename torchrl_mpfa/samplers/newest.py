"""Uniform sampling by a sampler that knows which transition is the newest."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torchrl.data import RandomSampler

from torchrl_mpfa.samplers.states import check_sampler
from torchrl_mpfa.saved import Entry

_FILE = "newest.json"
_NEWEST = Entry(
    "_newest",
    lambda newest: (
        newest is None
        or (
            isinstance(newest, list)
            and len(newest) > 0
            and all(type(p) is int and p >= 0 for p in newest)
        )
    ),
    "None, or a place for each dimension",
)


class NewestSampler(RandomSampler):
    """Uniform sampling by a sampler that takes note of the newest slot, and saves it.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(100), sampler=NewestSampler(), batch_size=4
        ... )
        >>> index = buffer.extend(TensorDict({"reward": torch.rand(10)}, [10]))
        >>> buffer.sampler.newest
        [9]
    """

    def __init__(self) -> None:
        super().__init__()
        self._newest: list[int] | None = None

    @property
    def newest(self) -> list[int] | None:
        """Its place along each dimension of the storage; None where none is known.

        A buffer that was filled before it got this sampler has no newest transition yet.
        """
        return self._newest

    def add(self, index: Any) -> None:
        """Take note of the newest slot."""
        super().add(index)
        self._note(index)

    def extend(self, index: Any) -> None:
        """Take note of the newest slot, the last of those written."""
        super().extend(index)
        self._note(index)

    def _note(self, index: Any) -> None:
        places = torch.stack(index, -1) if isinstance(index, tuple) else torch.as_tensor(index)
        places = places.reshape(-1, places.shape[-1] if places.ndim > 1 else 1)
        # TorchRL's writers mark with -1 what was not stored.
        stored = places[(places >= 0).all(-1)]
        if len(stored):
            self._newest = stored[-1].tolist()

    def _empty(self) -> None:
        super()._empty()
        self._newest = None

    def state_dict(self) -> dict[str, Any]:
        """The newest slot."""
        return {**super().state_dict(), "_newest": self._newest}

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Reject a state that does not fit, before anything changes.

        Raises:
            ValueError: If the newest slot is missing or none.
        """
        check_sampler(state_dict, [_NEWEST])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Raises:
            ValueError: See :meth:`check_state`.
        """
        self.check_state(state_dict)
        super().load_state_dict(state_dict)
        self._newest = state_dict["_newest"]

    def dumps(self, path: str | Path) -> None:
        """Save in a folder."""
        super().dumps(path)
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _FILE).write_text(json.dumps(self._newest), encoding="utf-8")

    def check_dump(self, path: str | Path) -> dict[str, Any]:
        """Read a saved sampler and reject it as :meth:`check_state` does."""
        state = {"_newest": json.loads((Path(path) / _FILE).read_text(encoding="utf-8"))}
        self.check_state(state)
        return state

    def loads(self, path: str | Path) -> None:
        """Restore from a folder.

        Raises:
            ValueError: See :meth:`check_state`.
        """
        state = self.check_dump(path)
        super().loads(path)
        self._newest = state["_newest"]
