r"""Reward-TD replay with a cap: once replayed often enough, a transition is drawn no more.

Zhao et al. (2023), MW-MADDPG, https://doi.org/10.3389/fnbot.2023.1243174. **A reduction to one
robot, and a reconstruction**: of that method, which is for several robots and learns to learn,
only the replay is taken. That its priority is made of reward and TD error, and that a transition
is not selected any more after some number of times, is said by its abstract and by the MPFA-PER
paper; that both are divided by their means and count the same, and the number, are our reading.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_mpfa.sampler import SignalSampler
from torchrl_mpfa.signals import SignalTable

_NO_LEAF = float("inf")


class CappedSampler(SignalSampler):
    """Excludes a transition that was replayed often enough.

    Where fewer transitions are left than a batch has, a batch is drawn uniformly from all, so that
    the training goes on. Mind the number: with one update of 256 transitions a step, each is
    replayed 256 times on average, and a cap below would leave little but the newest.

    Args:
        *args: As :class:`~torchrl_mpfa.SignalSampler`.
        replay_cap: How often a transition may be replayed.
        **kwargs: As :class:`~torchrl_mpfa.SignalSampler`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> CappedSampler(1000, 0.6, 0.4, signals=["reward", "td_error"]).replay_cap
        1024
    """

    def __init__(self, *args: Any, replay_cap: int = 1024, **kwargs: Any) -> None:
        if isinstance(replay_cap, bool) or not isinstance(replay_cap, int) or replay_cap < 1:
            raise ValueError(f"replay_cap must be a positive integer, got {replay_cap!r}")
        self.replay_cap = replay_cap
        super().__init__(*args, **kwargs)

    def _init(self) -> None:
        super()._init()
        self._spent = torch.zeros(self._max_capacity, dtype=torch.bool)

    def mark_update(self, index: int | Tensor, *, storage: Any = None) -> None:
        """Give fresh transitions the highest priority, and a count that starts anew."""
        slots = torch.as_tensor(index, dtype=torch.long).reshape(-1)
        self._spent[slots[slots >= 0]] = False
        super().mark_update(index, storage=storage)

    def _fused(self, table: SignalTable, rows: Tensor, slots: Tensor) -> Tensor:
        priority = super()._fused(table, rows, slots)
        self._spent[slots] = rows.select(1, table.count_column) >= self.replay_cap
        return priority

    def _write(self, index: Tensor, priority: Tensor) -> None:
        super()._write(index, priority)
        spent = index[self._spent[index]]
        if len(spent):
            self._sum_tree[spent] = torch.zeros(len(spent))
            # The lowest share of those that can be drawn is what weights are relative to.
            self._min_tree[spent] = torch.full((len(spent),), _NO_LEAF)

    def _draw(self, size: int, batch_size: int) -> tuple[Tensor, Tensor]:
        left = size - int(self._spent[:size].sum())
        if left >= batch_size:
            return super()._draw(size, batch_size)
        index = torch.randint(size, (batch_size,), generator=self._rng)
        return index, torch.ones(batch_size)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next batches depend on; tensors and plain values only."""
        return {**super().state_dict(), "_spent": self._spent.clone()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Raises:
            ValueError: See :meth:`check_state`.
        """
        super().load_state_dict(state_dict)
        self._spent = state_dict["_spent"].clone()
