"""Combined experience replay: the newest transition is in every batch.

Zhang and Sutton (2017), "A deeper look at experience replay", https://arxiv.org/abs/1712.01275
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import RandomSampler, Storage

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
        self._newest: int | None = None

    def add(self, index: int) -> None:
        """Take note of the newest slot."""
        super().add(index)
        self._newest = int(index)

    def extend(self, index: Tensor) -> None:
        """Take note of the newest slot, the last of those written."""
        super().extend(index)
        slots = torch.as_tensor(index).reshape(-1)
        if len(slots):
            self._newest = int(slots[-1])

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict[str, Any]]:
        """Draw slots.

        Args:
            storage: The storage to sample from.
            batch_size: ``B``.

        Returns:
            Slots, shape ``[B]``, and no information.

        Raises:
            RuntimeError: If the storage is empty.
        """
        index, info = super().sample(storage, batch_size)
        # A buffer that was filled before it got this sampler has no newest transition yet.
        if self._newest is not None:
            index[0] = self._newest
        return index, info

    def _empty(self) -> None:
        super()._empty()
        self._newest = None

    def state_dict(self) -> dict[str, Any]:
        """The newest slot."""
        return {**super().state_dict(), "_newest": self._newest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        super().load_state_dict(state_dict)
        self._newest = state_dict["_newest"]

    def dumps(self, path: str | Path) -> None:
        """Save in a folder."""
        super().dumps(path)
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _FILE).write_text(json.dumps(self._newest), encoding="utf-8")

    def loads(self, path: str | Path) -> None:
        """Restore from a folder."""
        super().loads(path)
        self._newest = json.loads((Path(path) / _FILE).read_text(encoding="utf-8"))
