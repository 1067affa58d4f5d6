r"""Change of priorities of positive transitions: Eqs. (22)-(24).

An adjustment takes the fused priorities of a batch and gives new ones. The paper has two, both
for *positive* transitions (reward above a level, zero in the paper): they are boosted, then those
above the average of their batch decay. Equation numbers: Cheng et al. (2023),
https://doi.org/10.3389/fnbot.2023.1281166. Shapes: ``B`` transitions in a batch.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, Literal, Protocol, get_args, runtime_checkable

import torch
from torch import Tensor

from torchrl_mpfa.checks import BELOW_ONE, LEVEL, POSITIVE, Rule, keep

if TYPE_CHECKING:
    from torchrl_mpfa.samplers.table import SignalTable

Level = float | Literal["mean"]
"""A reward, or ``"mean"``: the mean reward of the buffer."""
_ENOUGH = 1000
"""With fewer rewards there is no warning that all are on one side."""
Bound = Literal["floor", "cap", "none"]
Position = Literal["batch", "rank", "count"]
_BOUND: Rule = (lambda word: word in get_args(Bound), "'floor', 'cap' or 'none'")
_POSITION: Rule = (lambda word: word in get_args(Position), "'batch', 'rank' or 'count'")
_ROUNDING = 64
"""Units in the last place by which a priority has to exceed the mean of its batch."""


def is_positive(reward: Tensor, positive_above: Level, *, mean: float) -> Tensor:
    """Mask of positive transitions, :math:`r_i > 0` in the paper (Eqs. 17, 22-24), ``[B]``."""
    return reward > (mean if positive_above == "mean" else positive_above)


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
        mean_reward: Mean reward of the buffer when its probabilities were last counted.
        written_at: When each was written, as a count of writes, shape ``[B]``; None if unknown.
        counted: What the adjustment that is asked counted over the buffer, if it is
            :class:`Counting`; None before its first count.
    """

    reward: Tensor
    replay_count: Tensor
    index: Tensor
    mean_reward: float = 0.0
    written_at: Tensor | None = None
    counted: Tensor | None = None


@runtime_checkable
class Adjustment(Protocol):
    """A change of the priorities of a batch; any callable of this form will do.

    If it has an attribute ``takes_batches`` that is true, it may be given several batches at once:
    then each ``[B]`` is ``[U, B]``.
    """

    def __call__(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Adjust priorities, shape ``[B]`` to ``[B]``, not negative."""
        ...


@runtime_checkable
class Counting(Protocol):
    """An adjustment that depends on the whole buffer, which is counted from time to time.

    The result is handed to it as ``BatchFacts.counted``, and saved with the sampler.
    """

    @property
    def counts(self) -> bool:
        """True if the adjustment counts at all."""
        ...

    def count(self, table: SignalTable, priority: Tensor) -> Tensor:
        """Count.

        Args:
            table: Signals, rewards and times of every slot, ``N`` of which are filled.
            priority: Fused priorities, eps included and not adjusted, shape ``[N]``; NaN where not
                all signals are known yet.

        Returns:
            Finite numbers, of the same shape each time.
        """
        ...


def counts_buffer(adjustment: object) -> bool:
    """Return True if an adjustment counts the buffer."""
    return bool(getattr(adjustment, "counts", False))


@dataclass(frozen=True)
class PositiveBoost:
    r"""Eq. (22) for positive transitions, all others unchanged.

    Args:
        boost: Factor :math:`\varphi`; with ``target_share`` its upper bound.
        bound: See :func:`boost_positive`.
        positive_above: A transition is positive when its reward is above this. With 0 (the paper)
            every step towards the goal is; a value just under the goal reward leaves only goals,
            and ``"mean"``, the mean reward of the buffer, suits rewards of one sign.
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
    positive_above: Level = 0.0
    target_share: float = 0.0
    takes_batches: ClassVar[bool] = True

    def __post_init__(self) -> None:
        keep(self, boost=POSITIVE, positive_above=LEVEL, target_share=BELOW_ONE, bound=_BOUND)
        if self.target_share > 0 and self.boost < 1:
            raise ValueError(f"boost must be at least 1 with a target_share, got {self.boost}")

    @property
    def counts(self) -> bool:
        """True if the factor is estimated from the buffer."""
        return self.target_share > 0

    def count(self, table: SignalTable, priority: Tensor) -> Tensor:
        """Return the share of positive transitions in the buffer, shape ``[]``."""
        rewards = table.rewards
        mean = float(rewards.mean())
        return is_positive(rewards, self.positive_above, mean=mean).double().mean()

    def factor(self, counted: Tensor | None) -> float | Tensor:
        """Return the factor by the result of :meth:`count`; before a count, ``boost``."""
        if not self.counts or counted is None:
            return self.boost
        return adaptive_boost(counted, target=self.target_share, highest=self.boost)

    def __call__(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Boost the positive transitions, shape ``[B]``."""
        raised = boost_positive(priority, boost=self.factor(batch.counted), bound=self.bound)
        positive = is_positive(batch.reward, self.positive_above, mean=batch.mean_reward)
        return torch.where(positive, raised, priority)


@dataclass(frozen=True)
class PositiveDecay:
    r"""Eqs. (23)-(24): positive transitions above the batch mean decay once trained on.

    Args:
        sharpness: :math:`\sigma`.
        position: The reading of :math:`j`. ``"batch"`` (default, the letter of the paper): place
            in the batch, counted from 1, an arbitrary order; ``"rank"``: place when sorted by
            falling priority, so that the highest decays most; ``"count"``: how often the
            transition was replayed.
        positive_above: As in :class:`PositiveBoost`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> facts = BatchFacts(torch.tensor([1.0, 1.0]), torch.ones(2), torch.arange(2))
        >>> PositiveDecay()(torch.tensor([4.0, 2.0]), facts)
        tensor([2.0100, 2.0000])
    """

    sharpness: float = 0.01
    position: Position = "batch"
    positive_above: Level = 0.0
    takes_batches: ClassVar[bool] = True

    def __post_init__(self) -> None:
        keep(self, sharpness=POSITIVE, positive_above=LEVEL, position=_POSITION)

    def factors(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Return the factor of Eq. (23) for each transition, shape ``[B]``."""
        if self.position == "count":
            return decay_factor(batch.replay_count, sharpness=self.sharpness)
        by_place = _factors_by_place(
            priority.shape[-1], self.sharpness, priority.dtype, priority.device
        )
        if self.position == "batch":
            return by_place
        order = priority.argsort(dim=-1, descending=True, stable=True)
        return torch.empty_like(priority).scatter_(-1, order, by_place.expand_as(priority))

    def __call__(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Decay the positive transitions above the threshold, shape ``[B]``."""
        mean = decay_threshold(priority)
        # A number is faster on the CPU; a GPU would be waited for.
        threshold = mean.item() if mean.is_cpu and mean.ndim == 0 else mean.unsqueeze(-1)
        decayed = priority * self.factors(priority, batch)
        positive = is_positive(batch.reward, self.positive_above, mean=batch.mean_reward)
        # The mean of equal numbers may be rounded to below them.
        above = priority > threshold * (1.0 + _ROUNDING * torch.finfo(priority.dtype).eps)
        return torch.where(positive & above, decayed, priority)


@lru_cache(maxsize=64)
def _factors_by_place(
    count: int, sharpness: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Return factors of places 1 to ``count``: the same for every batch of that size."""
    places = torch.arange(1, count + 1, dtype=dtype, device=device)
    return decay_factor(places, sharpness=sharpness)


def level_of(parts: Iterable[object]) -> Level:
    """Return the first ``positive_above`` among the parts, or 0."""
    levels = (getattr(getattr(part, "fusion", part), "positive_above", None) for part in parts)
    return next((level for level in levels if level is not None), 0.0)


def one_sided(rewards: Tensor, parts: Iterable[object]) -> str | None:
    """Return a warning if all rewards of a buffer are on one side of a level of the parts.

    There is none for few rewards, nor for rewards that are all equal, which no level separates.
    """
    if len(rewards) < _ENOUGH or bool((rewards == rewards[0]).all()):
        return None
    # A fusion may stand around another one.
    inner = [getattr(part, "fusion", part) for part in parts]
    found = [(getattr(part, "positive_above", "mean"), hasattr(part, "weights")) for part in inner]
    for level in {level for level, _ in found if level != "mean"}:
        above = int((rewards > float(level)).sum())
        # A boost of goals alone waits for the first of them; the weights of Eq. (17) cannot.
        waits = above == 0 and float(level) > 0 and (level, True) not in found
        if above in (0, len(rewards)) and not waits:
            return (
                f"{'all' if above else 'none'} of the {len(rewards)} rewards in the buffer are "
                f"above {level}: by Eq. (17) TD error and gradient get no weight next to the "
                "reward, and boost and decay separate no transitions. Set positive_above to a "
                "level between the rewards, or to 'mean', with which all weights are equal"
            )
    return None
