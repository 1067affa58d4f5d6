"""A method: settings, and the parts of a replay that it makes of them.

A method of your own is a subclass: its fields are its settings, and it overrides the methods whose
parts differ. Parts are imported where they are made, as TorchRL's buffers take half a second.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, ClassVar

from torchrl_mpfa.checks import COUNT, COUNT_OR_ZERO, NOT_NEGATIVE, SHARE, Rule, keep, rules_of
from torchrl_mpfa.fusion import FixedFusion, Fusion

if TYPE_CHECKING:
    from torchrl.data import RandomSampler

    from torchrl_mpfa.adjustment import Adjustment
    from torchrl_mpfa.samplers.fused import SignalSampler
    from torchrl_mpfa.selection import Selection
    from torchrl_mpfa.signals import Signal

SWITCH: Rule = (lambda value: isinstance(value, bool), "true or false")


def within(rule: Rule, default: Any) -> Any:
    """Return a field with a default and the rule of its values."""
    return field(default=default, metadata={"rule": rule})


def one_of(*words: str) -> Any:
    """Return a field whose values are words, the first by default."""
    return within((lambda value: value in words, f"one of {', '.join(words)}"), words[0])


@dataclass
class Method:
    """Uniform replay, and the settings of every method.

    Raises:
        TypeError: If a number is of another type.
        ValueError: If a setting is out of its range.

    Examples:
        >>> Method("mine", batch_size=64).rows
        64
    """

    name: str = "uniform"
    """Name of the method."""
    capacity: int = within(COUNT, 100_000)
    """Transitions that the buffer holds (the paper's Table 1)."""
    batch_size: int = within(COUNT, 256)
    """Transitions in a batch (the paper's Table 1)."""
    importance: str = one_of("critic", "torchrl", "none")
    """Importance weights: ``critic`` (Eq. 11), ``torchrl`` (both losses) or ``none``."""
    loss_function: str = one_of("l2", "smooth_l1", "pal")
    """Distance of the critic's loss: ``l2`` (Eq. 4), ``smooth_l1`` (Huber) or ``pal``."""
    hindsight: int = within(COUNT_OR_ZERO, 0)
    """Goals for which each episode is learned from once more (HER); 0: none."""
    update_block: int = within(COUNT, 1)
    """Actions between two blocks of updates, of which there are as many as otherwise (RUD)."""

    kind: ClassVar[str] = "torchrl.data.RandomSampler"
    """Class of the sampler, by its full name: it is imported when a replay is made."""
    batches: ClassVar[str] = "torchrl_mpfa.selection.one_batch"
    """Function that samples the batches of one training step, by its full name."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Arguments of :func:`make_replay` that the method cannot do without."""
    why: ClassVar[str] = ""
    """Reason why the method needs these arguments."""
    needs_actor: ClassVar[bool] = False
    """True if the method is only for learners with an actor."""
    learner: ClassVar[str] = "torchrl_mpfa.ActorCritic"
    """Class of the learner with an actor, by its full name."""

    def __post_init__(self) -> None:
        keep(self, **rules_of(type(self)))

    @property
    def rows(self) -> int:
        """Transitions that the buffer samples for a batch."""
        return self.batch_size

    @property
    def pal_alpha(self) -> float:
        """Exponent of the loss PAL."""
        return 0.4

    @property
    def entries(self) -> tuple[str, ...]:
        """Extra entries that transitions must contain."""
        return ("episode",) if self.hindsight else ()

    @property
    def beside(self) -> tuple[str, ...]:
        """What a training has to do for the method beside its buffer and loss, by settings.

        Examples:
            >>> from torchrl_mpfa.methods import METHODS
            >>> METHODS["her"].beside, METHODS["per"].beside
            (('hindsight', 'episode'), ())
        """
        asked = {
            "hindsight": self.hindsight > 0,
            "bonus": type(self).bonus is not Method.bonus,
            "update_block": self.update_block != 1,
            "learner": self.learner != Method.learner,
        }
        return (*filter(asked.get, asked), *self.needs, *self.entries)

    @property
    def remote(self) -> bool:
        """True if the buffer may be in another process than the learner."""
        return not self.entries

    def beta_at(self, fraction: float) -> float | None:
        """Return the importance exponent after a part of the training; None without weights."""
        return None

    def priority_signals(self) -> list[Signal]:
        """Return the signals of the priority."""
        return []

    def sampler_options(self) -> dict[str, Any]:
        """Return the arguments of the sampler's class, beyond those of all prioritized ones."""
        return {}

    def learner_options(self) -> dict[str, Any]:
        """Return the arguments of the learner's class, beyond those of all methods."""
        return {}

    def bonus(self, observation_size: int, action_size: int) -> Any:
        """Make what adds a bonus to the rewards of a batch before the learner; None: no bonus.

        It is a module: called with a batch, it returns values for the log. Its ``checkpoint()`` is
        saved with a run, and its ``restore(state)`` called when that resumes.
        """
        return None

    def sampler(self) -> SignalSampler | RandomSampler:
        """Make the sampler."""
        return resolve_name(self.kind)(**self.sampler_options())

    def selection(self, policy: Any, sigma: Any) -> Selection:
        """Make the function that samples the batches of one training step.

        Args:
            policy: The policy in training, which is there if :attr:`needs` names it.
            sigma: Standard deviation of its exploration noise, or a function that gives it.
        """
        return resolve_name(self.batches)


@dataclass
class Prioritized(Method):
    """PER: one priority of one signal or several, sampled in proportion (Eq. 8).

    Several signals have equal weights.

    Examples:
        >>> Prioritized("mine", signals=["td_error", "novelty"]).alpha
        0.6
    """

    kind: ClassVar[str] = "torchrl_mpfa.samplers.SignalSampler"

    name: str = "per"
    signals: list[str] = field(default_factory=lambda: ["td_error"])
    """Signals of the priority."""
    alpha: float = within(NOT_NEGATIVE, 0.6)
    """Priority exponent, Eq. 8."""
    beta: float = within(SHARE, 0.4)
    """Importance exponent at the start, Eq. 10."""
    beta_end: float = within(SHARE, 1.0)
    """Importance exponent at the end; between the two it rises with the episodes."""
    eps: float = within(NOT_NEGATIVE, 0.05)
    """Added to every priority, Eq. 21."""
    max_priority_within_buffer: bool = within(SWITCH, True)
    """True: a fresh transition gets the highest priority in the buffer; false: the highest ever."""
    stratified: bool = within(SWITCH, False)
    """True: a batch has one transition from each of equal parts of the total priority."""
    positive_above = 0.0
    """Reward above which a transition is positive, for fusion and adjustments; no setting here."""

    def beta_at(self, fraction: float) -> float:
        """Return the importance exponent after a part of the training (Eq. 10)."""
        return self.beta + (self.beta_end - self.beta) * fraction

    def priority_signals(self) -> list[Signal]:
        """Return the signals of the priority; an unknown name is a signal of the loss."""
        from torchrl_mpfa.signals import as_signals

        return [*as_signals(self.signals)] if self.signals else []

    def fusion(self) -> Fusion:
        """Make the fusion of the signals."""
        return FixedFusion(dict.fromkeys(self.signals, 1.0))

    def adjustments(self) -> list[Adjustment]:
        """Make the adjustments of fused priorities, in their order."""
        return []

    def sampler(self) -> SignalSampler:
        """Make the sampler."""
        return resolve_name(self.kind)(
            self.capacity,
            self.alpha,
            self.beta,
            self.eps,
            max_priority_within_buffer=self.max_priority_within_buffer,
            stratified=self.stratified,
            signals=self.priority_signals(),
            fusion=self.fusion(),
            adjustments=self.adjustments(),
            positive_above=self.positive_above,
            **self.sampler_options(),
        )
