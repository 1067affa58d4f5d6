r"""Change of priorities of positive transitions: Eqs. (22)-(24).

An adjustment takes the fused priorities of a batch and gives new ones. The paper has two, both
for *positive* transitions (reward above a level, zero in the paper): they are boosted, then those
above the average of their batch decay. Equation numbers: Cheng et al. (2023),
https://doi.org/10.3389/fnbot.2023.1281166. Shapes: ``B`` transitions in a batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import torch

from torchrl_mpfa.checks import BELOW_ONE, POSITIVE, Rule, keep, kind_of

if TYPE_CHECKING:
    from torch import Tensor

    from torchrl_mpfa.samplers.table import SignalTable

Bound = Literal["floor", "cap", "none"]
Position = Literal["batch", "rank", "count"]
_BOUND: Rule = (lambda word: word in get_args(Bound), "'floor', 'cap' or 'none'")
_POSITION: Rule = (lambda word: word in get_args(Position), "'batch', 'rank' or 'count'")
_ROUNDING = 64
"""Units in the last place by which a priority has to exceed the mean of its batch."""


def boost_positive(
    priority: Tensor, *, boost: float | Tensor = 3.0, bound: Bound = "floor"
) -> Tensor:
    r"""Raised priority of a positive transition, :math:`p' = \max(\varphi p, 1)` (Eq. 22).

    Args:
        priority: Priorities of positive transitions, shape ``[B]``.
        boost: Factor :math:`\varphi`; the paper chose 3 out of 2, 3 and 4.
        bound: Role of the 1: a ``"floor"`` (the letter of Eq. 22), a ``"cap"`` (``min`` in place of
            ``max``), or ``"none"``.

    Returns:
        Priorities, shape ``[B]``.

    Examples:
        >>> boost_positive(torch.tensor([0.1, 2.0])).tolist()
        [1.0, 6.0]
    """
    raised = priority * boost
    if bound == "floor":
        return raised.clamp_min(1.0)
    return raised.clamp_max(1.0) if bound == "cap" else raised


def adaptive_boost(positive_share: Tensor, *, target: float, highest: float) -> Tensor:
    r"""Factor of Eq. (22) that follows how rare positive transitions are.

    .. math::

        \varphi = \min\left(\max\left(\frac{s}{1 - s} \cdot \frac{1 - q}{q},\, 1\right),
        \varphi_{\max}\right)

    With it positive transitions, a share :math:`q` of the buffer, have a share :math:`s` of the
    total priority, were all priorities equal before: their odds :math:`q / (1 - q)` become those of
    :math:`s`. It is bounded from below, as what is common needs no boost and is never held back,
    and from above, as importance weights cannot mend a batch that is a few transitions many times.
    The paper has a constant and names its adaptation as future work; this form is ours.

    Args:
        positive_share: Share :math:`q` of the transitions in the buffer that are positive, ``[]``.
        target: Share :math:`s` of the total priority that they are to have, in (0, 1).
        highest: :math:`\varphi_{\max}`, at least 1; the factor where nothing is positive.

    Returns:
        The factor, shape ``[]``.

    Examples:
        >>> share = torch.tensor([0.5, 0.25, 0.01])
        >>> adaptive_boost(share, target=0.5, highest=10.0).tolist()
        [1.0, 3.0, 10.0]
    """
    odds = target / (1.0 - target) * (1.0 - positive_share) / positive_share
    return odds.clamp(1.0, highest)


def decay_factor(position: Tensor, *, sharpness: float = 0.01) -> Tensor:
    r"""Factor by which a priority decays, :math:`1 / (1 + e^{-\sigma j})` (Eq. 23).

    Args:
        position: The number :math:`j` of each transition, shape ``[B]``.
        sharpness: :math:`\sigma`, which the paper does not give.

    Returns:
        Factors in [1/2, 1), shape ``[B]``: the *first* positions decay most.

    Examples:
        >>> decay_factor(torch.tensor([0.0])).tolist()
        [0.5]
    """
    return torch.sigmoid(position * sharpness)


def decay_threshold(priority: Tensor) -> Tensor:
    r"""Priority below which nothing decays, the batch mean :math:`p_{th}` (Eq. 24).

    Args:
        priority: Priorities of the whole batch, shape ``[B]``; ``[U, B]`` for several batches.

    Returns:
        The mean of each batch, shape ``[]`` or ``[U]``.

    Examples:
        >>> float(decay_threshold(torch.tensor([1.0, 3.0])))
        2.0
    """
    return priority.mean(-1)


@dataclass(frozen=True)
class BatchFacts:
    """Facts about the transitions of a batch, for adjustments.

    Attributes:
        reward: Signed rewards, shape ``[B]``.
        replay_count: How often each was sampled so far, this batch included, shape ``[B]``.
        index: Slots in the storage, shape ``[B]``.
        level: Reward above which a transition is positive.
        written_at: When each was written, as a count of writes, shape ``[B]``; None if unknown.
        counted: Result of :meth:`Adjustment.count` for the adjustment that is asked; None before
            its first count.
    """

    reward: Tensor
    replay_count: Tensor
    index: Tensor
    level: float = 0.0
    written_at: Tensor | None = None
    counted: Tensor | None = None

    @cached_property
    def positive(self) -> Tensor:
        """Mask of positive transitions, :math:`r_i > 0` in the paper (Eqs. 22-24), ``[B]``."""
        return self.reward > self.level


class Adjustment:
    """A change of the priorities of a batch.

    An adjustment of your own is a subclass with its ``__call__``.

    Examples:
        >>> class Half(Adjustment):
        ...     def __call__(self, priority, batch):
        ...         return 0.5 * priority
        >>> facts = BatchFacts(torch.tensor([1.0]), torch.ones(1), torch.arange(1))
        >>> Half()(torch.tensor([3.0]), facts)
        tensor([1.5000])
    """

    takes_batches: ClassVar[bool] = False
    """True if several batches may come at once: then each ``[B]`` is ``[U, B]``.

    A subclass says so itself, as its ``__call__`` may take one batch alone."""
    uses_level: ClassVar[bool] = False
    """True if the adjustment depends on which transitions are positive."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.takes_batches = vars(cls).get("takes_batches", False)

    @property
    def counts(self) -> bool:
        """True if the adjustment depends on the whole buffer, which is counted now and then."""
        return False

    def count(self, table: SignalTable, priority: Tensor) -> Tensor:
        """Count the buffer, for ``BatchFacts.counted``; the result is saved with the sampler.

        Args:
            table: Signals, rewards and times of every slot, ``N`` of which are filled.
            priority: Fused priorities, eps included and not adjusted, shape ``[N]``; NaN where not
                all signals are known yet.

        Returns:
            Finite numbers, of the same shape each time.
        """
        raise NotImplementedError(f"{type(self).__name__} must have a method count()")

    def __call__(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Adjust priorities, shape ``[B]`` to ``[B]``, not negative."""
        raise NotImplementedError(f"{type(self).__name__} must have a method __call__()")


def check_adjustments(adjustments: Any) -> None:
    """Reject anything but a list of adjustments."""
    listed = isinstance(adjustments, Sequence)
    if not (listed and all(isinstance(adjust, Adjustment) for adjust in adjustments)):
        kinds = ", ".join(map(kind_of, adjustments)) if listed else kind_of(adjustments)
        raise TypeError(f"adjustments must be a list of torchrl_mpfa.Adjustment, got {kinds}")


@dataclass(frozen=True)
class PositiveBoost(Adjustment):
    r"""Eq. (22) for positive transitions, all others unchanged.

    Args:
        boost: Factor :math:`\varphi`; with ``target_share`` its upper bound.
        bound: See :func:`boost_positive`.
        target_share: Share of the total priority that :func:`adaptive_boost` gives positive
            transitions, by a factor that follows how many the buffer holds; 0: a fixed factor.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> facts = BatchFacts(torch.tensor([1.0, -1.0]), torch.ones(2), torch.arange(2))
        >>> PositiveBoost()(torch.tensor([2.0, 2.0]), facts).tolist()
        [6.0, 2.0]
    """

    boost: float = 3.0
    bound: Bound = "floor"
    target_share: float = 0.0
    takes_batches: ClassVar[bool] = True
    uses_level: ClassVar[bool] = True

    def __post_init__(self) -> None:
        keep(self, boost=POSITIVE, target_share=BELOW_ONE, bound=_BOUND)
        if self.target_share > 0 and self.boost < 1:
            raise ValueError(f"boost must be at least 1 with a target_share, got {self.boost}")

    @property
    def counts(self) -> bool:
        """True if the factor is estimated from the buffer."""
        return self.target_share > 0

    def count(self, table: SignalTable, priority: Tensor) -> Tensor:
        """Return the share of positive transitions in the buffer, shape ``[]``."""
        return (table.rewards > table.level).double().mean()

    def factor(self, counted: Tensor | None) -> float | Tensor:
        """Return the factor by the result of :meth:`count`; before a count, ``boost``."""
        if not self.counts or counted is None:
            return self.boost
        return adaptive_boost(counted, target=self.target_share, highest=self.boost)

    def __call__(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Boost the positive transitions, shape ``[B]``."""
        raised = boost_positive(priority, boost=self.factor(batch.counted), bound=self.bound)
        return torch.where(batch.positive, raised, priority)


@dataclass(frozen=True)
class PositiveDecay(Adjustment):
    r"""Eqs. (23)-(24): positive transitions above the batch mean decay once trained on.

    Args:
        sharpness: :math:`\sigma`.
        position: The reading of :math:`j`. ``"batch"`` (default, the letter of the paper): place
            in the batch, counted from 1, an arbitrary order; ``"rank"``: place when sorted by
            falling priority, so that the highest decays most; ``"count"``: how often the
            transition was replayed.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> facts = BatchFacts(torch.tensor([1.0, 1.0]), torch.ones(2), torch.arange(2))
        >>> PositiveDecay()(torch.tensor([4.0, 2.0]), facts)
        tensor([2.0100, 2.0000])
    """

    sharpness: float = 0.01
    position: Position = "batch"
    takes_batches: ClassVar[bool] = True
    uses_level: ClassVar[bool] = True

    def __post_init__(self) -> None:
        keep(self, sharpness=POSITIVE, position=_POSITION)

    def factors(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Return the factor of Eq. (23) for each transition, shape ``[B]``."""
        if self.position == "count":
            return decay_factor(batch.replay_count, sharpness=self.sharpness)
        by_place = factors_by_place(
            priority.shape[-1], self.sharpness, priority.dtype, priority.device
        )
        if self.position == "batch":
            return by_place
        order = priority.argsort(dim=-1, descending=True, stable=True)
        return torch.empty_like(priority).scatter_(-1, order, by_place.expand_as(priority))

    def __call__(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Decay the positive transitions above the threshold, shape ``[B]``."""
        threshold = decay_threshold(priority).unsqueeze(-1)
        decayed = priority * self.factors(priority, batch)
        above = priority > threshold * above_mean(priority.dtype)
        return torch.where(batch.positive & above, decayed, priority)


def above_mean(dtype: torch.dtype) -> float:
    """Return the multiple of the mean of its batch that a priority has to exceed to decay.

    The mean of equal numbers may be rounded to below them.
    """
    return 1.0 + _ROUNDING * torch.finfo(dtype).eps


@lru_cache(maxsize=64)
def factors_by_place(
    count: int, sharpness: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Return factors of places 1 to ``count``: the same for every batch of that size."""
    places = torch.arange(1, count + 1, dtype=dtype, device=device)
    return decay_factor(places, sharpness=sharpness)
