"""Settings of the learners, each with its default and its reason."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_mpfa.checks import ABOVE_ZERO, NOT_NEGATIVE, POSITIVE, SHARE, Rule
from training.settings.rules import NAME, at_least, between, choice, setting, up_to

_COMPILE: Rule = (lambda value: value in ("auto", True, False), "auto, true or false")


@dataclass
class LearnerSettings:
    """DDPG of Table 1, with what keeps it from collapsing (see ``docs/tuning.md``)."""

    name: str = setting("ddpg", NAME)
    """Part of the run's folder and of its group in wandb."""
    algorithm: str = setting("ddpg", choice("ddpg", "td3", "sac", "dqn", "q_learning"))
    """``ddpg``, ``td3``, ``sac``, ``dqn`` or ``q_learning``; ``learner=td3`` chooses it with what
    goes with it."""
    actor_lr: float = setting(1e-4, POSITIVE)
    """Learning rate of the actor at the start; 1e-4 is the paper's (Table 1)."""
    critic_lr: float = setting(1e-4, POSITIVE)
    """Learning rate of the critics at the start; 1e-4 is the paper's (Table 1)."""
    lr_end_factor: float = setting(0.0, SHARE)
    """Learning rates fall with the episodes to this fraction of the first; 1: constant, by which
    DDPG forgets and relearns."""
    lr_power: float | None = setting(None, POSITIVE)
    """Shape of the fall: 1 is linear; 3 has halved the rates after a fifth of the episodes. Null: 1
    from 500 episodes on, 3 below."""
    gamma: float = setting(0.99, SHARE)
    """Discount of the next action's value (Table 1)."""
    tau: float = setting(0.01, ABOVE_ZERO)
    """Share by which a target network moves in an update; 0.01 is the paper's (Table 1)."""
    width: int = setting(64, up_to(2**16))
    """Units of a hidden layer."""
    layers: int = setting(2, up_to(100))
    """Hidden layers."""
    layer_norm: bool = True
    """Normalize hidden layers: features cannot grow without bound."""
    late_action: bool = True
    """The action joins the critic at its second layer, as in the original DDPG."""
    final_init: float | None = setting(3e-3, POSITIVE)
    """Last layers start within this, near the middle of the tanh; null: PyTorch's start."""
    critic_weight_decay: float = setting(1e-4, NOT_NEGATIVE)
    """L2 decay of the critic."""
    reward_scale: float = setting(0.1, between(1e-9, 1e9, "from 1e-9 to 1e9"))
    """Factor of rewards in the loss, so that Q is of order one."""
    saturation_penalty: float = setting(1.0, NOT_NEGATIVE)
    """Factor of the penalty on actions in the tanh's flat ends."""
    saturation_limit: float = setting(1.5, NOT_NEGATIVE)
    """Preactivations beyond this are penalized; tanh(1.5) = 0.905."""
    full_range: bool = False
    """True if actions reach their bounds at ``saturation_limit``. The tanh alone ends there at
    0.905: the robot never drives at its full speed."""
    compile: bool | str = setting("auto", _COMPILE)
    """Make one program of an update, which halves its time: ``true``, ``false``, or ``auto``: from
    5,000 updates on. Needs a C++ compiler, the headers of Python, and some seconds at the
    start."""
    policy_delay: int = setting(1, at_least(1))
    """DDPG and TD3: updates of the critics for one of the actor and the targets."""
    policy_noise: float = setting(0.0, NOT_NEGATIVE)
    """DDPG and TD3: standard deviation of the noise that smooths the target."""
    noise_clip: float = setting(0.5, NOT_NEGATIVE)
    """DDPG and TD3: bound of that noise."""
    alpha_init: float = setting(0.01, POSITIVE)
    """SAC: temperature of the entropy at the start, of rewards that are scaled."""
    alpha_lr: float = setting(3e-4, POSITIVE)
    """SAC: learning rate of the temperature's logarithm."""
    double: bool = True
    """DQN: true if the next action is chosen by the network, not by the target network."""
    table_lr: float = setting(0.2, ABOVE_ZERO)
    """Q learning: learning rate of the table, falling as the others do."""


@dataclass
class TD3Settings(LearnerSettings):
    """TD3 with networks and rates of the DDPG learner: two critics, smoothed target, delay."""

    name: str = "td3"
    algorithm: str = "td3"
    policy_delay: int = 2
    policy_noise: float = 0.2


@dataclass
class SACSettings(LearnerSettings):
    """SAC with networks and rates of the DDPG learner, and a stochastic policy."""

    name: str = "sac"
    algorithm: str = "sac"


@dataclass
class PlainSettings(LearnerSettings):
    """DDPG without the recipe, as the paper's code most likely had it."""

    name: str = "plain"
    width: int = 256
    layers: int = 3
    layer_norm: bool = False
    late_action: bool = True
    final_init: float | None = None
    lr_end_factor: float = 1.0
    critic_weight_decay: float = 0.0
    reward_scale: float = 1.0
    saturation_penalty: float = 0.0


@dataclass
class DQNSettings(LearnerSettings):
    """Double DQN with the critic's network and rate, of which an output is an action's value."""

    name: str = "dqn"
    algorithm: str = "dqn"
    critic_lr: float = 3e-4
    tau: float = 0.002
    """With 0.01 the targets run ahead, and the robot circles until the time is up."""


@dataclass
class QLearningSettings(LearnerSettings):
    """Q learning of a table over binned sensors; of the networks' settings it has none."""

    name: str = "q_learning"
    algorithm: str = "q_learning"
    gamma: float = 0.9
    """With 0.99 a cell as large as a meter, which leads to itself, is worth more than it should."""
    reward_scale: float = 1.0


def is_discrete(learner: LearnerSettings) -> bool:
    """Return True if the learner chooses among pairs of wheel speeds."""
    return learner.algorithm in ("dqn", "q_learning")
