r"""HVPER: TD error, Q value and number of replays, with weights that move with the training.

Cao et al. (2019), "High-value prioritized experience replay for off-policy reinforcement
learning", ICTAI 2019. **A reconstruction**: its abstract says that
priorities combine TD error and state-action value, and the MPFA-PER paper adds that the amount of
data counts and that the weights vary with the phase of the training. That both terms are brought
to [0, 1] within a batch, the schedule of the weights and the penalty on replays are our reading:

.. math::

    p_i = \max(\lambda V_i + (1 - \lambda) T_i - \kappa U_i, \epsilon)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchrl_mpfa.adjustment import Adjustment, BatchFacts
from torchrl_mpfa.checks import NOT_NEGATIVE, POSITIVE, SHARE, check, keep
from torchrl_mpfa.fusion import FixedFusion, Fusion
from torchrl_mpfa.methods import Prioritized
from torchrl_mpfa.methods.base import within
from torchrl_mpfa.signals import Signal

if TYPE_CHECKING:
    from torchrl_mpfa.samplers.table import SignalTable


def relative_value(value: Tensor) -> Tensor:
    """Compute Q relative to its batch, ``V``: the sigmoid of its standard score.

    Args:
        value: Q, shape ``[B]``.

    Returns:
        Numbers in (0, 1), shape ``[B]``; 1/2 is the mean.

    Examples:
        >>> relative_value(torch.tensor([-3.0, -3.0])).tolist()
        [0.5, 0.5]
    """
    centered = value - value.mean()
    spread = centered.square().mean().sqrt()
    return torch.sigmoid(centered / torch.where(spread > 0, spread, 1.0))


def relative_error(td_error: Tensor) -> Tensor:
    r"""Compute the TD error relative to its batch, ``T``: its share of the largest.

    Args:
        td_error: :math:`|\delta|`, shape ``[B]``.

    Returns:
        Numbers in [0, 1], shape ``[B]``.

    Examples:
        >>> relative_error(torch.tensor([1.0, 4.0])).tolist()
        [0.25, 1.0]
    """
    largest = td_error.max()
    return td_error / torch.where(largest > 0, largest, 1.0)


RELATIVE_VALUE = Signal("relative_value", key=("signals", "value"), priority=relative_value)
"""V: the loss writes ``"value"``, and the table keeps its place within the batch."""
RELATIVE_ERROR = Signal("relative_td_error", key=("signals", "td_error"), priority=relative_error)
"""T, likewise."""


@dataclass
class ScheduledFusion(Fusion):
    """Weights that are interpolated linearly from one set to another over the training.

    Args:
        start: Weight of each signal at the start, by name; a signal without one is not counted.
        end: Weight of each signal at the end.

    Raises:
        ValueError: As :class:`~torchrl_mpfa.FixedFusion`.

    Examples:
        >>> fusion = ScheduledFusion({"td_error": 1.0}, {"td_error": 0.5, "value": 0.5})
        >>> fusion.anneal(0.5)
        >>> fusion.weights(["td_error", "value"], None, None).tolist()
        [0.75, 0.25]
    """

    start: dict[str, float]
    end: dict[str, float]

    def __post_init__(self) -> None:
        self._ends = FixedFusion(self.start), FixedFusion(self.end)
        self.start, self.end = (fusion.values for fusion in self._ends)
        self._fraction = 0.0

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Signals that must be fused."""
        return tuple(dict.fromkeys((*self.start, *self.end)))

    @property
    def every_batch(self) -> bool:
        """Weights follow the training."""
        return True

    def anneal(self, fraction: float) -> None:
        """Move to a share of the training that is done, from 0 to 1.

        Raises:
            ValueError: If ``fraction`` is outside.
        """
        self._fraction = check(SHARE, fraction=fraction)

    def weights(self, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor:
        """Return the present weights in the order of ``names``, shape ``[K]``."""
        start, end = (fusion.weights(names, table, index) for fusion in self._ends)
        return start.lerp(end, self._fraction)


def value_schedule(*, final_share: float = 0.5) -> ScheduledFusion:
    r"""Make weights that go from the TD error alone to an equal part of Q, which is wrong at first.

    Args:
        final_share: :math:`\lambda` at the end of the training.

    Returns:
        The fusion.

    Raises:
        ValueError: If the share is outside [0, 1].

    Examples:
        >>> value_schedule().end
        {'relative_value': 0.5, 'relative_td_error': 0.5}
    """
    final_share = check(SHARE, final_share=final_share)
    value, error = RELATIVE_VALUE.name, RELATIVE_ERROR.name
    return ScheduledFusion({value: 0.0, error: 1.0}, {value: final_share, error: 1.0 - final_share})


@dataclass(frozen=True)
class HVPERPenalty(Adjustment):
    r"""Lower priorities of often replayed transitions, :math:`\max(p_i - \kappa U_i, \epsilon)`.

    ``U`` is the number of replays as a share of the largest one in the batch.

    Args:
        penalty: :math:`\kappa`.
        floor: :math:`\epsilon`, so that no transition is lost.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> facts = BatchFacts(torch.zeros(2), torch.tensor([1.0, 4.0]), torch.arange(2))
        >>> HVPERPenalty(penalty=0.4)(torch.tensor([1.0, 1.0]), facts).tolist()
        [0.8999999761581421, 0.6000000238418579]
    """

    penalty: float = 0.25
    floor: float = 0.01

    def __post_init__(self) -> None:
        keep(self, penalty=NOT_NEGATIVE, floor=POSITIVE)

    def __call__(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Lower priorities by the replays of their transitions, shape ``[B]``."""
        count = batch.replay_count.to(priority.dtype)
        share = count / count.max().clamp_min(1.0)
        return (priority - self.penalty * share).clamp_min(self.floor)


@dataclass
class HVPER(Prioritized):
    """Places of Q value and TD error in the batch, with a schedule and a penalty on replays."""

    name: str = "hvper"
    signals: list[str] = field(default_factory=lambda: ["relative_value", "relative_td_error"])
    eps: float = 0.01
    replay_penalty: float = within(NOT_NEGATIVE, 0.25)
    """Penalty on replays."""

    def priority_signals(self) -> list[Signal]:
        """Return the signals of the priority; an unknown name is a signal of the loss."""
        relative = {signal.name: signal for signal in (RELATIVE_VALUE, RELATIVE_ERROR)}
        return [relative.get(signal.name, signal) for signal in super().priority_signals()]

    def fusion(self) -> Fusion:
        """Make the fusion with a schedule."""
        return value_schedule()

    def adjustments(self) -> list[Adjustment]:
        """Make the penalty."""
        return [HVPERPenalty(penalty=self.replay_penalty, floor=self.eps)]
