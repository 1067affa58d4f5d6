"""Combined experience replay: the newest transition is in every batch.

Zhang and Sutton (2017), "A deeper look at experience replay", https://arxiv.org/abs/1712.01275
"""

from __future__ import annotations

from typing import Any

from torchrl.data import Storage

from torchrl_mpfa.samplers.newest import NewestSampler


class CERSampler(NewestSampler):
    """Uniform sampling, but for the first transition of each batch, which is the newest.

    Examples:
        >>> import torch
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
            for each, place in zip(along, self.newest, strict=True):
                each[0] = place
        return index, info
