r"""LA3P: the critic learns from large TD errors, the actor from small ones, both from a fair share.

Saglam et al. (2023), "Actor prioritized experience replay", Journal of Artificial Intelligence
Research 78, https://doi.org/10.1613/jair.1.14819. An actor that follows the critic where the critic
is wrong learns little: it gets transitions in proportion to the *inverse* of the priority.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import torch
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from torchrl_mpfa.checks import Rule, check
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.samplers.trees import make_trees
from torchrl_mpfa.selection import SampledBatch

Part = Literal["uniform", "prioritized", "inverse"]
_LOG_LARGEST = math.log(torch.finfo(torch.double).max) - 1.0
_TINY = torch.finfo(torch.double).tiny


class LA3PSampler(SignalSampler):
    r"""Samples a part of a batch: uniformly, by priority, or by the inverse of the priority.

    Within :meth:`part`, which :func:`la3p_batches` uses, a batch has the size of that part, see
    :meth:`sizes`; outside of it, it is a whole one by priority. All weights are 1.

    Args:
        *args: As :class:`~torchrl_mpfa.SignalSampler`.
        uniform_fraction: Share :math:`1 - \lambda` of a batch that is sampled uniformly.
        **kwargs: As :class:`~torchrl_mpfa.SignalSampler`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> sampler = LA3PSampler(1000, 0.4, 0.0, signals=["td_error"])
        >>> sampler.sizes(256)
        (128, 128)
    """

    KIND = "la3p"

    def __init__(self, *args: Any, uniform_fraction: float = 0.5, **kwargs: Any) -> None:
        inside: Rule = (lambda share: 0.0 < share < 1.0, "in (0, 1)")
        self.uniform_fraction: float = check(inside, uniform_fraction=uniform_fraction)
        self._part: Part | None = None
        super().__init__(*args, **kwargs)

    def _init(self) -> None:
        super()._init()
        self._inverse = make_trees(self._max_capacity, self.device)

    def _follow(self, slots: Tensor, leaf: Tensor) -> None:
        self._inverse.put(slots, 1.0 / leaf)

    def _checked(self, priority: Tensor, name: str = "priority") -> float:
        highest = super()._checked(priority, name)
        # Not so low that the inverse overflows, which a priority of zero would be.
        lowest = priority.min().item()
        least = (math.log(self._max_capacity) - _LOG_LARGEST) / max(self._alpha, _TINY)
        if not (lowest > 0 and math.log(lowest) > least):
            raise ValueError(f"priority must not be so low that its inverse overflows: {lowest}")
        return highest

    def sizes(self, batch_size: int) -> tuple[int, int]:
        """Size of the uniform part of a batch, and of the other two.

        Raises:
            ValueError: If a part would be empty.
        """
        uniform = round(batch_size * self.uniform_fraction)
        if not 0 < uniform < batch_size:
            raise ValueError(
                f"batch_size must leave no part empty, got {batch_size} for a uniform_fraction of "
                f"{self.uniform_fraction}"
            )
        return uniform, batch_size - uniform

    @contextmanager
    def part(self, part: Part) -> Iterator[None]:
        """Sample this part alone for as long as this is open."""
        before, self._part = self._part, part
        try:
            yield
        finally:
            self._part = before

    def _sample_slots(self, size: int, batch_size: int) -> tuple[Tensor, Tensor]:
        count = batch_size
        if self._part is not None:
            count = self.sizes(batch_size)[self._part != "uniform"]
        if self._part == "uniform":
            index = self._uniform(size, count)
        else:
            trees = self._inverse if self._part == "inverse" else self.trees
            index, _ = self._proportional(trees, size, count)
        return index, torch.ones(count, device=self.device)

    def batch_weights(self, size: int) -> Tensor:
        """All 1, see :meth:`TreeSampler.batch_weights`."""
        return torch.ones(size, dtype=torch.double, device=self.device)

    def _restore(self, state: dict[str, Any]) -> None:
        super()._restore(state)
        if len(slots := self._known()):
            leaves = self.trees.leaves(slots)
            if not bool((leaves > 0).all()):
                raise ValueError("'_sum_tree' of the saved sampler must be positive, got 0")
            self._inverse.put(slots, 1.0 / leaves)


def la3p_batches(buffer: TensorDictReplayBuffer) -> Iterator[SampledBatch]:
    """The three updates of an LA3P step, in the order of the authors' code.

    Critic and actor learn from a uniform part of the batch, with the loss PAL; then the critic from
    a part by priority, with the Huber loss; then the actor from one by the inverse. Each is sampled
    when it is asked for, by priorities that the update before it is to have changed.

    Args:
        buffer: The buffer, with an :class:`LA3PSampler` and a batch size.

    Yields:
        Three batches.

    Raises:
        TypeError: If the buffer has another sampler.
    """
    sampler = buffer.sampler
    if not isinstance(sampler, LA3PSampler):
        raise TypeError(f"buffer must have an LA3PSampler, got {type(sampler).__name__}")
    with sampler.part("uniform"):
        batch = buffer.sample()
    yield SampledBatch(batch, loss_function="pal")
    with sampler.part("prioritized"):
        batch = buffer.sample()
    yield SampledBatch(batch, trains="critic", loss_function="smooth_l1", new_step=False)
    with sampler.part("inverse"):
        batch = buffer.sample()
    yield SampledBatch(batch, trains="actor", new_step=False)


def uniform_halves(buffer: TensorDictReplayBuffer) -> Iterator[SampledBatch]:
    """Sample two halves of a uniform batch, the control of LA3P, for an update each.

    An LA3P step makes two updates of critic and actor on half batches, where others make one on a
    whole batch. The control shows the gain of that alone, without priorities.

    Args:
        buffer: The buffer, with a uniform sampler and a batch size.

    Yields:
        Two batches of one training step, for critic and actor.

    Raises:
        ValueError: If a half would be empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), batch_size=8)
        >>> index = buffer.extend(TensorDict({"reward": torch.rand(10)}, [10]))
        >>> [len(sampled.batch) for sampled in uniform_halves(buffer)]
        [4, 4]
    """
    batch = buffer.sample()
    if len(batch) < 2:
        raise ValueError(f"batch_size must be at least 2 for two halves, got {len(batch)}")
    half = len(batch) // 2
    yield SampledBatch(batch[:half])
    yield SampledBatch(batch[half:], new_step=False)
