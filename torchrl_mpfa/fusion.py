r"""From several signals to one priority: Eqs. (15)-(21).

Notation of Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166, and the names here.
The paper uses some letters twice; the right-hand column has one name for each meaning.

====================  ==========  ================================================================
paper                 equation    here
====================  ==========  ================================================================
gamma                 2, 5        ``gamma``: discount
tau                   6, 7        ``tau``: step of the target networks
delta_i               4, 13       ``td_error``: y_i - Q(s_i, a_i)
alpha                 8           ``alpha``: priority exponent
beta                  10          ``beta``: importance exponent (not the beta of Eq. 19)
w_i                   10, 11      ``priority_weight``: TorchRL's key for importance weights
p_i^r, p_i^TD,        12-14       the signals ``reward``, ``td_error``, ``action_gradient``
p_i^loss
H(X)                  15          :func:`binary_entropy`
H(r)                  16          :func:`reward_entropy`
H(TD) = H(loss)       17          :func:`positive_entropy`
a, beta, nu           18-20       :func:`entropy_weights` (one weight a signal, summing to one)
epsilon               9, 21       ``eps``: added once, before the boost
p_i                   21          :func:`fuse`
phi                   22          ``boost``: factor of positive transitions
sigma, j, p_th        23, 24      ``sharpness``, ``position``, :func:`decay_threshold`
eps_p                 25          ``progress_scale`` of the navigation reward
====================  ==========  ================================================================

Shapes: ``N`` transitions in the buffer, ``B`` in a batch, ``K`` signals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import torch

from torchrl_mpfa.checks import (
    BELOW_ONE,
    NOT_NEGATIVE,
    Level,
    Rule,
    check,
    check_not_negative,
    check_shape,
    keep,
    kind_of,
    unknown,
)

if TYPE_CHECKING:
    from torch import Tensor

    from torchrl_mpfa.samplers.table import SignalTable


def binary_entropy(first: Tensor, second: Tensor) -> Tensor:
    r"""Entropy of two outcomes, :math:`H = -\sum_i p_i \log_2 p_i` (Eq. 15).

    Args:
        first: Probability of one outcome, shape ``[]``.
        second: Probability of the other, shape ``[]``.

    Returns:
        Entropy in bits, shape ``[]``; an impossible outcome adds nothing (0 log 0 = 0).

    Examples:
        >>> float(binary_entropy(torch.tensor(0.5), torch.tensor(0.5)))
        1.0
    """
    # xlogy has the limit 0 log 0 = 0 built in; dividing by log 2 makes it bits. The entropy of a
    # certain event is -(1 log 1) = -0.0, and adding 0.0 takes that sign away.
    shares = torch.stack((first, second))
    return -torch.special.xlogy(shares, shares).sum() / torch.log(shares.new_full((), 2.0)) + 0.0


def _split_entropy(reward: Tensor, level: float) -> Tensor:
    """Return the entropy of being above a level, which an equal reward is not."""
    if reward.numel() == 0:
        raise ValueError(f"reward must hold at least one transition, got shape {[*reward.shape]}")
    above = (reward > level).double().mean()
    return binary_entropy(above, 1.0 - above)


def reward_entropy(reward: Tensor) -> Tensor:
    r"""Entropy of the immediate reward, H(r) of Eq. (16).

    A reward equal to the average counts as not above it, so that both shares add to one.

    Args:
        reward: Signed rewards of the population, shape ``[N]``.

    Returns:
        Entropy in bits of being above or below the average reward, shape ``[]``.

    Raises:
        ValueError: If ``reward`` is empty.

    Examples:
        >>> float(reward_entropy(torch.tensor([0.0, 0.0, 1.0, 1.0])))
        1.0
    """
    return _split_entropy(reward, float(reward.double().mean()))


def positive_entropy(reward: Tensor, *, positive_above: Level = 0.0) -> Tensor:
    r"""Entropy of positive training, H(TD) = H(loss) of Eq. (17).

    Neither the TD error nor the gradient enters: by the paper both entropies are those of the
    sign of the reward, hence equal. Where all rewards have one sign they are zero.

    Args:
        reward: Signed rewards of the population, shape ``[N]``.
        positive_above: A transition is positive when its reward is above this: 0 in the paper, or
            ``"mean"``, the mean of ``reward``, with which this is Eq. (16).

    Returns:
        Entropy in bits of the reward being positive, shape ``[]``.

    Raises:
        ValueError: If ``reward`` is empty.

    Examples:
        >>> float(positive_entropy(torch.tensor([-1.0, 2.0])))
        1.0
        >>> pendulum = torch.tensor([-8.0, -6.0, -1.0, -0.1])
        >>> float(positive_entropy(pendulum))
        0.0
        >>> float(positive_entropy(pendulum, positive_above="mean"))
        1.0
    """
    if positive_above == "mean":
        return reward_entropy(reward)
    return _split_entropy(reward, positive_above)


def entropy_weights(entropies: Tensor) -> Tensor:
    r"""Weights a, beta and nu of the signals: each entropy's share of their sum (Eqs. 18-20).

    Eq. (20) writes the last weight as one minus the others, which is the same.

    Args:
        entropies: One entropy a signal, shape ``[K]``.

    Returns:
        Weights that sum to one, shape ``[K]``; equal ones if every entropy is zero, where
        Eqs. (18)-(20) would divide by zero.

    Raises:
        ValueError: If an entropy is negative or not finite.

    Examples:
        >>> entropy_weights(torch.tensor([1.0, 0.5, 0.5])).tolist()
        [0.5, 0.25, 0.25]
    """
    if not bool(((entropies >= 0) & entropies.isfinite()).all()):
        raise ValueError(f"entropies must be finite and not negative, got {entropies.tolist()}")
    total = entropies.sum()
    if total <= 0:
        return torch.full_like(entropies, 1.0 / entropies.numel())
    return entropies / total


def fuse(signals: Tensor, weights: Tensor, *, eps: float) -> Tensor:
    r"""One priority from K signals, :math:`p_i = \sum_k w_k p_i^k + \epsilon` (Eq. 21).

    Args:
        signals: Non-negative signals, shape ``[B, K]``.
        weights: One weight a signal, shape ``[K]``.
        eps: The constant :math:`\epsilon` that gives every transition a chance to be sampled.

    Returns:
        Priorities, shape ``[B]``.

    Examples:
        >>> fuse(torch.tensor([[1.0, 3.0]]), torch.tensor([0.5, 0.5]), eps=0.0).tolist()
        [2.0]
    """
    # Signal by signal: a product of matrices adds in an order that depends on their size.
    priority, *others = (signals * weights).unbind(1)
    for share in others:
        priority = priority + share
    return priority + eps


class Fusion:
    """One weight for each signal, computed from the buffer.

    A fusion of your own is a subclass with its :meth:`weights`; it may keep state. The sampler asks
    for weights when enough of the buffer was rewritten.

    Examples:
        >>> class Equal(Fusion):
        ...     def weights(self, names, table, index):
        ...         return torch.ones(len(names))
        >>> Equal().every_batch
        False
    """

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Signals that the sampler must fuse."""
        return ()

    @property
    def every_batch(self) -> bool:
        """True if the weights hold for one batch alone: they are asked for at every update."""
        return False

    @property
    def uses_level(self) -> bool:
        """True if the weights depend on ``table.positive_above``."""
        return False

    def anneal(self, fraction: float) -> None:
        """Move to a share of the training that is done, from 0 to 1; by default nothing moves."""

    def entropies(self, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor | None:
        """Return the entropy of each signal, shape ``[K]``, for statistics; None where none is."""
        return None

    def weights(self, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor:
        """Weigh the signals.

        Args:
            names: The K signals that the sampler fuses.
            table: Signals and rewards of every slot; ``table.rewards`` has shape ``[N]``. So has
                a signal, ``table.rows[: table.size, table.column[name]]``, NaN where it is unknown.
            index: Slots of the batch at hand, shape ``[B]``.

        Returns:
            One weight a signal, in the order of ``names``, shape ``[K]``.
        """
        raise NotImplementedError(f"{type(self).__name__} must have a method weights()")


def check_fusion(fusion: Any, fused: Sequence[str]) -> None:
    """Reject what is no fusion, or one of signals that are not fused."""
    if not isinstance(fusion, Fusion):
        raise TypeError(f"fusion must be a torchrl_mpfa.Fusion, got {kind_of(fusion)}")
    for name in fusion.signal_names:
        if name not in fused:
            raise ValueError(unknown("signal of the fusion", name, fused))


def checked_weights(
    fusion: Fusion, names: Sequence[str], table: SignalTable, index: Tensor
) -> Tensor:
    """Return the checked weights of a fusion, in double precision, shape ``[K]``."""
    name = "weights of the fusion"
    weights = check_shape(name, fusion.weights(names, table, index), (len(names),))
    check_not_negative(name, weights)
    return weights.to(table.rows.device, torch.double)


@dataclass(frozen=True)
class EntropyFusion(Fusion):
    r"""Weights by information entropy, Eqs. (16)-(20).

    Args:
        reward_signals: Signals weighted by the entropy of the reward (Eq. 16), by default
            ``reward`` where it is fused; every other one gets that of positive training (Eq. 17),
            a user's own too. No signal is weighted by its own values: the weights of TD error and
            action gradient are equal by definition.
        population: Transitions that the probabilities are counted over: the whole ``"buffer"``
            (default), or the ``"batch"``, which prioritized sampling biases.
        floor: Smallest weight a signal may get before the weights are normalized again; 0 is the
            paper, whose TD weight vanishes once all rewards are positive.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> EntropyFusion().population
        'buffer'
    """

    reward_signals: Sequence[str] | None = None
    population: Literal["buffer", "batch"] = "buffer"
    floor: float = 0.0

    def __post_init__(self) -> None:
        names = self.reward_signals
        if isinstance(names, str) or not isinstance(names, Sequence | None):
            raise TypeError(f"reward_signals must be names, got {self.reward_signals!r}")
        population: Rule = (lambda word: word in ("buffer", "batch"), "'buffer' or 'batch'")
        keep(self, floor=BELOW_ONE, population=population)

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Signals that must be fused."""
        return () if self.reward_signals is None else tuple(self.reward_signals)

    @property
    def every_batch(self) -> bool:
        """Weights that are counted over a batch hold for that batch alone."""
        return self.population == "batch"

    @property
    def uses_level(self) -> bool:
        """Eq. (17) counts positive transitions."""
        return True

    def entropies(self, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor:
        """Return the entropy of each signal in bits, Eqs. (16)-(17), shape ``[K]``."""
        rewards = table.rewards if self.population == "buffer" else table.rewards[index]
        of_reward = reward_entropy(rewards)
        of_positive = positive_entropy(rewards, positive_above=table.positive_above)
        by_reward = ("reward",) if self.reward_signals is None else self.reward_signals
        return torch.stack([of_reward if name in by_reward else of_positive for name in names])

    def weights(self, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor:
        """Return the weights a, beta, nu of Eqs. (18)-(20), shape ``[K]``."""
        weights = entropy_weights(self.entropies(names, table, index))
        if self.floor > 0:
            weights = weights.clamp_min(self.floor)
            weights = weights / weights.sum()
        return weights


@dataclass(frozen=True)
class FixedFusion(Fusion):
    """Weights that never change; one signal of weight one is plain PER.

    Args:
        values: Weight of each signal by name; a signal without one is not counted.

    Raises:
        TypeError: If ``values`` is no mapping.
        ValueError: If a weight is negative or not finite, or all are zero.

    Examples:
        >>> FixedFusion({"td_error": 1.0}).values
        {'td_error': 1.0}
    """

    values: dict[str, float] = field(default_factory=lambda: {"td_error": 1.0})

    def __post_init__(self) -> None:
        if not isinstance(self.values, Mapping):
            raise TypeError(f"values must be a weight for each signal, got {self.values!r}")
        values = {n: check(NOT_NEGATIVE, **{f"weight of {n!r}": v}) for n, v in self.values.items()}
        object.__setattr__(self, "values", values)
        if not any(self.values.values()):
            raise ValueError(f"values must have a positive weight, got {self.values}")

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Signals that must be fused."""
        return tuple(self.values)

    def weights(self, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor:
        """Return the fixed weights in the order of ``names``, shape ``[K]``."""
        values = [self.values.get(name, 0.0) for name in names]
        return torch.tensor(values, dtype=torch.double, device="cpu")


@dataclass(frozen=True)
class ScaledFusion(Fusion):
    """Weights of another fusion for signals that are first divided by their mean in the buffer.

    Signals of different units then have the shares in a priority that their weights say.

    Args:
        fusion: Source of the weights.

    Examples:
        >>> ScaledFusion(FixedFusion({"reward": 0.5, "td_error": 0.5})).every_batch
        False
    """

    fusion: Fusion

    def __post_init__(self) -> None:
        if not isinstance(self.fusion, Fusion):
            raise TypeError(f"fusion must be a Fusion, got {kind_of(self.fusion)}")

    @property
    def signal_names(self) -> tuple[str, ...]:
        """As the other fusion."""
        return self.fusion.signal_names

    @property
    def every_batch(self) -> bool:
        """As the other fusion."""
        return self.fusion.every_batch

    @property
    def uses_level(self) -> bool:
        """As the other fusion."""
        return self.fusion.uses_level

    def anneal(self, fraction: float) -> None:
        """Move the other fusion."""
        self.fusion.anneal(fraction)

    def weights(self, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor:
        """Return weights divided by the means of the signals, shape ``[K]``."""
        weights = self.fusion.weights(names, table, index)
        places = torch.tensor([table.column[name] for name in names], device="cpu")
        signals = table.rows[: table.size, places]
        mean = signals.nanmean(0).to(weights.dtype)
        # A signal that is zero everywhere, or known of no transition yet, has no scale.
        return weights.to(mean.device) / torch.where(mean > 0, mean, 1.0)
