"""A mixture: each signal has its own tree, and its part of every batch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchrl_mpfa.moving_fusion import ScaledFusion
from torchrl_mpfa.priorities import importance_weights
from torchrl_mpfa.samplers.signal_sampler import SignalSampler
from torchrl_mpfa.samplers.slots import leaves_of
from torchrl_mpfa.samplers.tree import TreeSampler
from torchrl_mpfa.saved import Entry


class MixtureSampler(SignalSampler):
    r"""Samples each transition by one of the signals, chosen by the weights of the fusion.

    .. math::

        P(i) = \sum_k \frac{w_k}{\sum_j w_j} \cdot
        \frac{(p_i^k + \epsilon)^\alpha}{\sum_l (p_l^k + \epsilon)^\alpha}

    A signal has its share of a batch whatever its scale and however rare its peaks are: a few large
    rewards cannot crowd out the TD errors, as they can in a sum. What adjustments make of the sum
    of Eq. (21), as a factor, holds for each signal; a fresh transition gets the highest priority by
    each of them. Importance weights are divided by a bound of the largest one, that of a transition
    which is the least by every signal.

    Args:
        *args: As :class:`~torchrl_mpfa.SignalSampler`.
        **kwargs: As :class:`~torchrl_mpfa.SignalSampler`. The fusion gives the shares; one that
            divides signals by their scale is rejected, as they have none here.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> sampler = MixtureSampler(1000, 0.6, 0.4, 0.05, signals=["reward", "td_error"])
        >>> sampler.shares.tolist()
        [0.5, 0.5]
    """

    KIND = "mixture"

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if isinstance(self.fusion, ScaledFusion):
            raise ValueError("fusion of a mixture must not be scaled: give the one inside of it")
        if self.combination != "sum":
            raise ValueError(f"combination of a mixture must be 'sum', got {self.combination!r}")

    def _init(self) -> None:
        super()._init()
        self._parts = {
            signal.name: TreeSampler(
                self._max_capacity,
                self._alpha,
                self._beta,
                0.0,
                device=self.device,
                max_priority_within_buffer=self._max_priority_within_buffer,
            )
            for signal in self.signals
        }

    @property
    def shares(self) -> Tensor:
        """Share of each signal in a batch, in the order of their columns, shape ``[K]``."""
        if self._weighing is None:
            equal = torch.full((len(self._names),), 1.0 / len(self._names), dtype=torch.double)
            return equal.to(self.device)
        return self._weighing.weights / self._weighing.weights.sum()

    def _write(self, slots: Tensor, priority: Tensor, *, learned: bool) -> None:
        super()._write(slots, priority, learned=learned)
        if not learned:
            for part in self._parts.values():
                part.mark_update(slots)
            return
        for name, value in self._by_signal(slots, priority).items():
            self._parts[name]._set(slots, value, float(value.max()))

    def _by_signal(self, slots: Tensor, priority: Tensor) -> dict[str, Tensor]:
        """The priority of each slot by each of the signals, shape ``[B]``."""
        if self._table is None or self._weighing is None:
            return dict.fromkeys(self._names, priority)
        rows = self._table.rows[slots]
        factor = priority / self._combined(rows, self._weighing)
        found = {}
        for name in self._names:
            value = (rows[:, self._table.column[name]] + self._eps) * factor
            # A priority that was set directly, of a transition whose signals are not known.
            found[name] = torch.where(value.isfinite(), value, priority)
        return found

    def _sample_slots(self, size: int, batch_size: int) -> tuple[Tensor, Tensor]:
        shares = self.shares
        generator = self._random()["generator"]
        chosen = torch.multinomial(shares, batch_size, replacement=True, generator=generator)
        index = torch.empty(batch_size, dtype=torch.long, device=self.device)
        trees = [self._parts[name] for name in self._names]
        totals, lowest = self._sums(shares, size)
        if not (min(totals) > 0 and lowest > 0):
            raise RuntimeError(
                f"every priority must be positive to sample, got sums of {totals} by signal: raise "
                "eps, or give the buffer its sampler before its data"
            )
        for number, part in enumerate(trees):
            rows = (chosen == number).nonzero().squeeze(1)
            if len(rows):
                index[rows] = self._proportional(part._sum_tree, size, len(rows))
        probability = self._probability(index, shares, totals)
        return index, importance_weights(probability, beta=self._beta, lowest=lowest)

    def batch_weights(self, size: int) -> Tensor:
        """See :meth:`TreeSampler.batch_weights`."""
        shares = self.shares
        totals, lowest = self._sums(shares, size)
        slots = torch.arange(size, device=self.device)
        probability = self._probability(slots, shares, totals)
        return importance_weights(probability, beta=self._beta, lowest=lowest)

    def _sums(self, shares: Tensor, size: int) -> tuple[list[Any], Any]:
        """Sum of each signal's leaves, and a bound of the lowest probability."""
        trees = [self._parts[name] for name in self._names]
        totals = [part._sum_tree.query(0, size) for part in trees]
        lowest = sum(
            share * part._min_tree.query(0, size) / total
            for share, part, total in zip(shares.tolist(), trees, totals, strict=True)
        )
        return totals, lowest

    def _probability(self, index: Tensor, shares: Tensor, totals: list[Any]) -> Tensor:
        """Probability of slots, shape ``[B]``."""
        probability = torch.zeros(len(index), dtype=torch.double, device=self.device)
        for share, name, total in zip(shares.tolist(), self._names, totals, strict=True):
            leaf = leaves_of(self._parts[name]._sum_tree, index)
            probability += leaf * (share / total)
        return probability

    def _check_alpha(self, value: float) -> None:
        super()._check_alpha(value)
        for part in self._parts.values():
            part._check_alpha(value)

    def _retransform_priority_trees(self, old_alpha: float, new_alpha: float) -> None:
        super()._retransform_priority_trees(old_alpha, new_alpha)
        for part in self._parts.values():
            part.alpha = new_alpha

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next batches depend on; tensors and plain values only."""
        parts = {name: part.state_dict() for name, part in self._parts.items()}
        return {**super().state_dict(), "_parts": parts}

    def _entries(self) -> list[Entry]:
        names = sorted(self._parts)
        words = f"a tree for each of {names}"
        return [
            *super()._entries(),
            Entry("_parts", lambda p: isinstance(p, Mapping) and sorted(p) == names, words),
        ]

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Reject a state that does not fit, before anything changes."""
        super().check_state(state_dict)
        for name, part in self._parts.items():
            part.check_state(state_dict["_parts"][name])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave, or raise as :meth:`check_state` does."""
        super().load_state_dict(state_dict)
        for name, part in self._parts.items():
            part.load_state_dict(state_dict["_parts"][name])
