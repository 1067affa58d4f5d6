"""Uniform halves: the control of LA3P, with as many updates and no priorities.

An LA3P step makes two updates of critic and actor on half batches each, where others make one on a
whole batch. What it gains by that alone, and not by its priorities, this shows.
"""

from __future__ import annotations

from collections.abc import Iterator

from torchrl.data import TensorDictReplayBuffer

from torchrl_mpfa.selection import SampledBatch


def uniform_halves(buffer: TensorDictReplayBuffer) -> Iterator[SampledBatch]:
    """Two updates of critic and actor, each on a half of what the buffer samples.

    Args:
        buffer: The buffer, with a uniform sampler and a batch size.

    Yields:
        Two batches of one training step.

    Raises:
        ValueError: If a half would be empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), batch_size=8)
        >>> index = buffer.extend(TensorDict({"reward": torch.rand(10)}, [10]))
        >>> [len(each.batch) for each in uniform_halves(buffer)]
        [4, 4]
    """
    batch = buffer.sample()
    if len(batch) < 2:
        raise ValueError(f"batch_size must leave no half empty, got {len(batch)}")
    half = len(batch) // 2
    yield SampledBatch(batch[:half])
    yield SampledBatch(batch[half:], new_step=False)
