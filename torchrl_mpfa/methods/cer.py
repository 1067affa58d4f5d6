"""Combined experience replay: the newest transition is in every batch.

Zhang and Sutton (2017), "A deeper look at experience replay", https://arxiv.org/abs/1712.01275
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torchrl.data import RandomSampler, Storage

from torchrl_mpfa.samplers.states import entry, refuse

_FILE = "newest.json"


class CombinedSampler(RandomSampler):
    """Uniform sampling, but for the first transition of each batch, which is the newest.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(100), sampler=CombinedSampler(), batch_size=4
        ... )
        >>> index = buffer.extend(TensorDict({"reward": torch.rand(10)}, [10]))
        >>> int(buffer.sample()["index"][0])
        9
    """

    def __init__(self) -> None:
        super().__init__()
        self._newest: list[int] | None = None

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

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict[str, Any]]:
        """Sample slots.

        Args:
            storage: The storage to sample from.
            batch_size: ``B``.

        Returns:
            Slots, shape ``[B]``, or for a storage of several dimensions a tuple of places along
            each; and no information.

        Raises:
            RuntimeError: If the storage is empty.
        """
        index, info = super().sample(storage, batch_size)
        # A buffer that was filled before it got this sampler has no newest transition yet.
        if self._newest is not None:
            along = index if isinstance(index, tuple) else (index,)
            for each, place in zip(along, self._newest, strict=True):
                each[0] = place
        return index, info

    def _empty(self) -> None:
        super()._empty()
        self._newest = None

    def state_dict(self) -> dict[str, Any]:
        """The newest slot."""
        return {**super().state_dict(), "_newest": self._newest}

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Refuse a state that does not fit, before anything changes.

        Raises:
            ValueError: If the newest slot is missing or none.
        """
        newest = entry(state_dict, "_newest")
        if newest is None:
            return
        whole = isinstance(newest, list) and newest
        if not whole or not all(type(place) is int and place >= 0 for place in newest):
            refuse("_newest", "None, or a place for each dimension", newest)

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
        """Read a saved sampler and refuse it as :meth:`check_state` does."""
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
