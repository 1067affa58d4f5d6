r"""Reward-TD replay with a cap: once replayed often enough, a transition is sampled no more.

Zhao et al. (2023), MW-MADDPG, https://doi.org/10.3389/fnbot.2023.1243174. **A reduction to one
robot, and a reconstruction**: of that method, which is for several robots and learns to learn,
only the replay is taken. That its priority is made of reward and TD error, and that a transition
is not selected any more after some number of times, is said by its abstract and by the MPFA-PER
paper; that both are divided by their means and count the same, and the number, are our reading.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchrl_mpfa.checks import COUNT, check_counts
from torchrl_mpfa.fusion import Fusion, ScaledFusion
from torchrl_mpfa.methods import Prioritized
from torchrl_mpfa.methods.base import within
from torchrl_mpfa.samplers.fused import SignalSampler


class MWSampler(SignalSampler):
    """Excludes a transition that was replayed often enough.

    Where fewer transitions are left than a batch has, a batch is sampled uniformly from all, so
    that the training continues. Mind the number: with one update of 256 transitions a step, each is
    replayed 256 times on average, and a cap below would leave little but the newest.

    Args:
        *args: As :class:`~torchrl_mpfa.SignalSampler`.
        replay_cap: Largest number of replays of a transition.
        **kwargs: As :class:`~torchrl_mpfa.SignalSampler`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> MWSampler(1000, 0.6, 0.4, signals=["reward", "td_error"]).replay_cap
        1024
    """

    KIND = "capped"
    SAVED = (*SignalSampler.SAVED, "_spent")

    def __init__(self, *args: Any, replay_cap: int = 1024, **kwargs: Any) -> None:
        self.replay_cap: int = check_counts(replay_cap=replay_cap)
        super().__init__(*args, **kwargs)

    @property
    def divisible(self) -> bool:
        """False: sampling depends on the number of transitions that are left for a batch."""
        return False

    def _init(self) -> None:
        super()._init()
        self._spent = torch.zeros(self._max_capacity, dtype=torch.bool, device=self.device)

    def _write(self, slots: Tensor, priority: Tensor, *, learned: bool) -> None:
        if not learned:
            self._spent[slots] = False  # The count of a fresh transition starts again.
        super()._write(slots, priority, learned=learned)

    def _set(self, slots: Tensor, priority: Tensor, highest: float) -> None:
        self._spent[slots] = self.table.replay_counts(slots) >= self.replay_cap
        super()._set(slots, priority, highest)

    def _follow(self, slots: Tensor, leaf: Tensor) -> None:
        spent = slots[self._spent[slots]]
        if len(spent):
            # Weights are relative to the lowest share of those that can be sampled.
            self.trees.put(spent, leaf.new_full((len(spent),), -0.0))

    def _sample_slots(self, size: int, batch_size: int) -> tuple[Tensor, Tensor]:
        left = size - int(self._spent[:size].sum())
        if left >= batch_size:
            return super()._sample_slots(size, batch_size)
        return self._uniform(size, batch_size), torch.ones(batch_size, device=self.device)


@dataclass
class MW(Prioritized):
    """Reward and TD error in equal shares, with a cap on replays (MW-MADDPG)."""

    kind: ClassVar[str] = "benchmarks.paper.methods.mw.MWSampler"

    name: str = "mw"
    signals: list[str] = field(default_factory=lambda: ["reward", "td_error"])
    replay_cap: int = within(COUNT, 1024)
    """Replays after which a transition is excluded."""

    def fusion(self) -> Fusion:
        """Make the fusion in equal shares."""
        return ScaledFusion(super().fusion())

    def sampler_options(self) -> dict[str, Any]:
        """Return the cap."""
        return {"replay_cap": self.replay_cap}
