r"""Rank-based prioritized replay: a transition counts by its place, not by its size.

Schaul et al. (2016), "Prioritized experience replay", https://arxiv.org/abs/1511.05952
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_mpfa.checks import NOT_NEGATIVE, check
from torchrl_mpfa.samplers.fused import SignalSampler


def rank_share(rank: Tensor, *, alpha: float) -> Tensor:
    r"""Share of a transition by its rank, :math:`(1 / \mathrm{rank}(i))^\alpha`.

    Args:
        rank: Places by falling priority, counted from 1, shape ``[B]``.
        alpha: Priority exponent :math:`\alpha`.

    Returns:
        Shares, shape ``[B]``.

    Examples:
        >>> rank_share(torch.tensor([1.0, 4.0]), alpha=0.5).tolist()
        [1.0, 0.5]
    """
    return rank.pow(-alpha)


class RankPERSampler(SignalSampler):
    r"""Sampling by :math:`P(i) \propto (1 / \mathrm{rank}(i))^\alpha`, insensitive to outliers.

    Ranks are by the fused and adjusted priority; with the TD error alone this is the rank-based
    variant of PER. Equal priorities, as fresh transitions have, count by the mean of their ranks.
    All transitions are sorted from time to time; in between, the new priority of a transition gets
    the rank that it would have had in the last order, as the original, too, sorts but now and then.

    Args:
        *args: As :class:`~torchrl_mpfa.SignalSampler`.
        rank_refresh: Share of the buffer whose priority may be written again before all are
            sorted; 0 sorts at every update.
        **kwargs: As :class:`~torchrl_mpfa.SignalSampler`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> RankPERSampler(1000, 0.7, 0.5, signals=["td_error"]).rank_refresh
        0.25
    """

    KIND = "rank"
    SAVED = (*SignalSampler.SAVED, "_order", "_written")

    def __init__(self, *args: Any, rank_refresh: float = 0.25, **kwargs: Any) -> None:
        self.rank_refresh: float = check(NOT_NEGATIVE, rank_refresh=rank_refresh)
        super().__init__(*args, **kwargs)

    def _init(self) -> None:
        super()._init()
        # Priorities at the last sorting, negated, so that they rise with the rank.
        self._order = torch.empty(0, dtype=torch.double, device=self.device)
        self._written = 0

    def _leaf(self, priority: Tensor) -> Tensor:
        # By the ranks that priorities would have in the last order.
        order, negated = self._order, -priority
        above = torch.searchsorted(order, negated)
        # Equal ones share the mean of their places; one that has no equal stands after those above.
        until = torch.searchsorted(order, negated, right=True).maximum(above + 1)
        return rank_share((above + until + 1).double() / 2, alpha=self._alpha)

    def _write(self, slots: Tensor, priority: Tensor, *, learned: bool) -> None:
        super()._write(slots, priority, learned=learned)
        self._written += len(slots)
        if self._written > self.rank_refresh * len(self._order):
            self._sort()

    def _sort(self) -> None:
        """Give every written slot its true rank."""
        slots = self._known()
        self._order, places = self.priorities(slots).neg().sort()
        _, equal = self._order.unique_consecutive(return_counts=True)
        ranks = equal.cumsum(0) - (equal.double() - 1) / 2
        shares = rank_share(ranks, alpha=self._alpha).repeat_interleave(equal)
        self._write_leaves(slots, torch.empty_like(shares).index_copy_(0, places, shares))
        self._written = 0

    def _retransform_priority_trees(self, old_alpha: float, new_alpha: float) -> None:
        if len(self._order):
            self._sort()

    def _restore(self, state: dict[str, Any]) -> None:
        super()._restore(state)
        if not bool((self._order.diff() >= 0).all()):
            raise ValueError("'_order' of the saved sampler must be of rising numbers")
