"""Uniform sampling that knows the newest transition, and combined experience replay by it.

Combined experience replay has the newest transition in every batch: Zhang and Sutton (2017), "A
deeper look at experience replay", https://arxiv.org/abs/1712.01275
"""

from __future__ import annotations

from typing import Any

import torch
from torchrl.data import RandomSampler, Storage

from torchrl_mpfa.samplers.states import SavedSampler
from torchrl_mpfa.storages.entries import as_integers


class NewestSampler(SavedSampler, RandomSampler):
    """Uniform sampling that keeps and saves the newest slot."""

    KIND = "newest"
    SAVED = ("newest",)

    def __init__(self) -> None:
        super().__init__()
        self.newest: list[int] | None = None
        """Place of the newest slot along each dimension of the storage; None if unknown.

        A buffer that was filled before it got this sampler has no newest transition yet.
        """

    def add(self, index: Any) -> None:
        """Record the newest slot."""
        super().add(index)
        self._record(index)

    def extend(self, index: Any) -> None:
        """Record the newest slot, the last of those written."""
        super().extend(index)
        self._record(index)

    def _record(self, index: Any) -> None:
        places = torch.stack(index, -1) if isinstance(index, tuple) else as_integers(index)
        places = places.reshape(-1, places.shape[-1] if places.ndim > 1 else 1)
        # TorchRL's writers mark with -1 what was not stored.
        stored = places[(places >= 0).all(-1)]
        if len(stored):
            self.newest = stored[-1].tolist()

    def _empty(self) -> None:
        super()._empty()
        self.newest = None


class CERSampler(NewestSampler):
    """Uniform sampling, but for the first transition of each batch, which is the newest.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(100), sampler=CERSampler(), batch_size=4
        ... )
        >>> index = buffer.extend(TensorDict({"reward": torch.rand(10)}, [10]))
        >>> int(buffer.sample()["index"][0])
        9
    """

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict[str, Any]]:
        """Sample slots as TorchRL's ``RandomSampler`` does, the newest first."""
        index, info = super().sample(storage, batch_size)
        if self.newest is not None:
            along = index if isinstance(index, tuple) else (index,)
            for places, place in zip(along, self.newest, strict=True):
                places[0] = place
        return index, info
