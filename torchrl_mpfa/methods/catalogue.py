"""Every method by name: a class for each kind of them, and the settings of each.

``docs/methods/README.md`` links to the page of each. A method of your own is a subclass of
:class:`~torchrl_mpfa.methods.Method`, and one more entry in :data:`METHODS`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

from torchrl_mpfa.adjustment import Adjustment, PositiveBoost, PositiveDecay
from torchrl_mpfa.checks import BELOW_ONE, LEVEL, NOT_NEGATIVE, POSITIVE, SHARE, unknown
from torchrl_mpfa.fusion import EntropyFusion, Fusion, ScaledFusion
from torchrl_mpfa.methods.base import SWITCH, Method, Prioritized, one_of, within
from torchrl_mpfa.methods.lap import LAPFloor

if TYPE_CHECKING:
    from torchrl_mpfa.selection import Selection


@dataclass
class Adjusted(Prioritized):
    """PER whose priorities of positive transitions are raised and decayed (Eqs. 22-24)."""

    boost: bool = within(SWITCH, False)
    """Raise positive transitions, Eq. 22."""
    boost_factor: float = within(POSITIVE, 3.0)
    """phi of Eq. 22; its upper bound where ``boost_target`` is above 0."""
    boost_target: float = within(BELOW_ONE, 0.0)
    """Share of the total priority that positive transitions are to have, by a phi that follows how
    rare they are in the buffer; 0: phi is fixed."""
    boost_bound: str = one_of("floor", "cap", "none")
    """The 1 of Eq. 22: ``floor``, ``cap`` or ``none``."""
    decay: bool = within(SWITCH, False)
    """Decay positive transitions above the batch mean, Eqs. 23-24."""
    decay_sharpness: float = within(POSITIVE, 0.01)
    """sigma of Eq. 23."""
    decay_position: str = one_of("batch", "rank", "count")
    """j of Eq. 23: ``batch``, ``rank`` or ``count``."""
    positive_above: Any = field(default=0.0, metadata={"rule": LEVEL})
    """A transition is positive, in Eqs. 17 and 22-24, when its reward is above this: a number, or
    ``mean``, the mean reward of the buffer, for rewards of one sign."""

    def adjustments(self) -> list[Adjustment]:
        """Make the boost and the decay that are on."""
        parts: list[Adjustment] = []
        if self.boost:
            bound: Any = self.boost_bound  # Hydra knows no literal types.
            parts.append(PositiveBoost(self.boost_factor, bound, self.boost_target))
        if self.decay:
            position: Any = self.decay_position
            parts.append(PositiveDecay(self.decay_sharpness, position))
        return parts


@dataclass
class MPFA(Adjusted):
    """MPFA-PER: signals weighted by information entropy (Eqs. 15-21), raised and decayed."""

    name: str = "mpfa_per"
    signals: list[str] = field(default_factory=lambda: ["reward", "td_error", "action_gradient"])
    boost: bool = True
    decay: bool = True
    weight_floor: float = within(BELOW_ONE, 0.0)
    """Least weight of a signal: without one the reward alone counts until the first goal; 0: none,
    as in the paper."""
    population: str = one_of("buffer", "batch")
    """Transitions that Eqs. 16-17 count: ``buffer`` or ``batch``."""

    def fusion(self) -> Fusion:
        """Make the fusion by entropy weights."""
        population: Any = self.population
        return EntropyFusion(population=population, floor=self.weight_floor)


@dataclass
class Scaled(Adjusted):
    """Signals in equal shares: each is divided by its mean."""

    name: str = "mpfa_plus"
    signals: list[str] = field(default_factory=lambda: ["reward", "td_error", "action_gradient"])
    # Signals are in units of their means, of which a floor of 1 is not one.
    boost_bound: str = "none"
    # More than a step can bring, and less than a goal.
    positive_above: Any = 1.0

    def fusion(self) -> Fusion:
        """Make the fusion in equal shares."""
        return ScaledFusion(super().fusion())


@dataclass
class RankPER(Prioritized):
    """PER by rank."""

    kind: ClassVar[str] = "torchrl_mpfa.methods.rank_per.RankPERSampler"

    name: str = "rank_per"
    alpha: float = 0.7
    beta: float = 0.5


@dataclass
class ReaPER(Prioritized):
    """PER whose TD errors count by how reliable they are; transitions need ``"episode"``."""

    kind: ClassVar[str] = "torchrl_mpfa.methods.reaper.ReaPERSampler"

    name: str = "reaper"
    alpha: float = 0.3
    max_priority_within_buffer: bool = False
    reliability: float = within(POSITIVE, 0.3)
    """omega: power of how reliable a TD error is."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hindsight:
            raise ValueError(
                f"hindsight must be 0 with {self.name}, which adds up the errors of an episode's "
                f"own rows, got {self.hindsight}"
            )

    @property
    def entries(self) -> tuple[str, ...]:
        """The number of the episode."""
        return ("episode",)

    def sampler_options(self) -> dict[str, Any]:
        """Return the power of the reliability."""
        return {"exponent": self.reliability}


@dataclass
class LAP(Prioritized):
    """Priorities with a floor where the Huber loss bends, and no importance weights."""

    name: str = "lap"
    alpha: float = 0.4
    eps: float = 0.0
    max_priority_within_buffer: bool = False
    importance: str = "none"
    loss_function: str = "smooth_l1"
    priority_floor: float = within(POSITIVE, 1.0)
    """Least priority, in units of the reward."""

    @property
    def pal_alpha(self) -> float:
        """Exponent of the loss PAL."""
        return self.alpha

    def adjustments(self) -> list[Adjustment]:
        """Make the floor."""
        return [LAPFloor(self.priority_floor)]


@dataclass
class LA3P(LAP):
    """The critic learns from large errors, the actor from small ones, both from a fair share."""

    kind: ClassVar[str] = "torchrl_mpfa.methods.la3p.LA3PSampler"
    batches: ClassVar[str] = "torchrl_mpfa.methods.la3p.la3p_batches"

    name: str = "la3p"
    # Its parts have losses of their own: PAL on the uniform one, Huber on the prioritized one.
    loss_function: str = one_of("smooth_l1")
    needs_actor: ClassVar[bool] = True

    @property
    def remote(self) -> bool:
        """False: its parts depend on each other."""
        return False


@dataclass
class PAL(Method):
    """Uniform replay with LAP's equivalent loss."""

    name: str = "pal"
    loss_function: str = "pal"
    alpha: float = within(NOT_NEGATIVE, 0.4)
    """Exponent of the loss."""

    @property
    def pal_alpha(self) -> float:
        """Exponent of the loss PAL."""
        return self.alpha


@dataclass
class CER(Method):
    """Uniform replay with the newest transition in every batch."""

    kind: ClassVar[str] = "torchrl_mpfa.samplers.uniform.CERSampler"

    name: str = "cer"


@dataclass
class Geometric(Method):
    """Replay by age: the older a transition, the less often."""

    kind: ClassVar[str] = "torchrl_mpfa.methods.geometric.GeometricSampler"

    name: str = "geometric"
    recency: float = within(NOT_NEGATIVE, 3.0)
    """c: the newest transition is sampled e^c times as often as the oldest."""

    def sampler_options(self) -> dict[str, Any]:
        """Return the rate."""
        return {"recency": self.recency}


@dataclass
class UniformHalves(Method):
    """Two updates on uniform halves of a batch, the control of LA3P."""

    batches: ClassVar[str] = "torchrl_mpfa.methods.la3p.uniform_halves"

    name: str = "uniform_halves"
    needs_actor: ClassVar[bool] = True


@dataclass
class ReFER(Method):
    """Uniform replay of transitions that are near to the policy (ReF-ER)."""

    kind: ClassVar[str] = "torchrl_mpfa.methods.ref_er.ReFERSampler"

    name: str = "ref_er"
    far_share: float = within(SHARE, 0.1)
    """Share of transitions that may be far from the policy before the policy is held."""
    far_cutoff: float = within(POSITIVE, 4.0)
    """C: a ratio of densities of 1 + C or its inverse is far."""
    needs: ClassVar[tuple[str, ...]] = ("policy",)
    why: ClassVar[str] = "it compares actions with its own"
    needs_actor: ClassVar[bool] = True

    @property
    def entries(self) -> tuple[str, ...]:
        """The behavior's action without noise, and its standard deviation."""
        return (*super().entries, "behavior_mean", "behavior_sigma")

    def selection(self, policy: Any, sigma: Any) -> Selection:
        """Make the selection that leaves out far transitions."""
        from torchrl_mpfa.methods.ref_er import ReFERSelection

        return ReFERSelection(policy, far_share=self.far_share, cutoff=self.far_cutoff)


METHODS: dict[str, Method] = {
    # The paper's method, and its ablations.
    "mpfa_per": MPFA(),
    "mpfa_adaptive": MPFA("mpfa_adaptive", boost_target=0.5, boost_factor=10.0),
    "mpfa_plus": Scaled(),
    "mpf_per": MPFA("mpf_per", boost=False, decay=False),
    "td_reward": MPFA("td_reward", signals=["reward", "td_error"], boost=False, decay=False),
    "td_loss": MPFA("td_loss", signals=["td_error", "action_gradient"], boost=False, decay=False),
    "per": Prioritized(),
    "raise": Adjusted("raise", boost=True),
    "decay": Adjusted("decay", decay=True),
    # What the paper compares with.
    "ddpg": Method("ddpg"),
    "ref_er": ReFER(),
    "rud": Method("rud", update_block=1000),
    # What else there is today.
    "rank_per": RankPER(),
    "reaper": ReaPER(),
    "uper": Prioritized("uper", signals=["information_gain"], eps=0.01),
    "lap": LAP(),
    "pal": PAL(),
    "la3p": LA3P(),
    "uniform_halves": UniformHalves(),
    "cer": CER(),
    "geometric": Geometric(),
    "her": Method("her", hindsight=4),
    # Another word for uniform replay, for learners that are not DDPG.
    "uniform": Method(),
}
"""Every method by name."""

ALIASES = {"uniform": "ddpg"}
"""Second names, which pages and figures leave out."""


RECONSTRUCTED = ("klper", "averaged_ddpg", "hvper", "ddpg_radam", "mw")
"""Methods that come with a plugin of the repository."""
PLUGIN = "benchmarks/paper/methods/reconstructions.py"
"""Path of this plugin in the repository."""


def unknown_method(name: str) -> str:
    """Return the error of an unknown method; of a reconstruction, with the plugin that has it.

    Examples:
        >>> unknown_method("mpfa-per")
        "unknown method 'mpfa-per': did you mean 'mpfa_per'?"
    """
    if name not in RECONSTRUCTED:
        return unknown("method", name, METHODS)
    module = PLUGIN.removesuffix(".py").replace("/", ".")
    return f"method {name!r} comes with a plugin: add --plugin {PLUGIN}, in Python import {module}"


def method_named(method: str | Method, **settings: Any) -> Method:
    """Return a method with some of its settings changed.

    Args:
        method: A name out of :data:`METHODS`, or a method of your own.
        **settings: Other values for its settings.

    Raises:
        TypeError: If ``method`` is neither, or a number is of another type.
        ValueError: If the method or a setting is unknown, or a value is out of its range.

    Examples:
        >>> method_named("per", alpha=0.7).alpha
        0.7
    """
    if isinstance(method, str):
        if method not in METHODS:
            raise ValueError(unknown_method(method))
        method = METHODS[method]
    elif not isinstance(method, Method):
        raise TypeError(f"method must be a name or a Method, got {method!r}")
    settings_of = [setting.name for setting in fields(method)]
    for name in settings:
        if name not in settings_of:
            raise ValueError(unknown(f"setting of {method.name}", name, settings_of))
    return replace(method, **settings)
