"""Settings of a training run: typed, in one place, each with its default and its reason.

Hydra builds its command line from these: ``train.py method=per learner.width=128 seed=3``. The
settings of a method are those of :class:`torchrl_mpfa.methods.Method`; what values are allowed is
in ``checks.py``.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from navigation.assessment import AssessmentSettings
from navigation.environment_settings import EnvironmentSettings
from navigation.ray_settings import RaySettings
from torchrl_mpfa.methods import METHODS, Method


@dataclass
class LearnerSettings:
    """DDPG of Table 1, with what keeps it from collapsing (see ``docs/design.md``)."""

    name: str = "ddpg"
    algorithm: str = "ddpg"
    """``ddpg``, ``td3``, ``sac``, ``dqn`` or ``q_learning``; ``learner=td3`` chooses it with what
    goes with it. The last two choose among seven pairs of wheel speeds."""
    actor_lr: float = 1e-4
    """Table 1."""
    critic_lr: float = 1e-4
    """Table 1."""
    lr_end_factor: float = 0.0
    """Learning rates fall with the episodes from Table 1's to this fraction; 1: constant. At a
    constant rate DDPG forgets and relearns, and the last policy is a matter of luck."""
    lr_power: float | None = None
    """Shape of the fall: 1 is linear, right for a thousand episodes; 3 has halved the rates after a
    fifth of them, right for a hundred. Null: 1 from 500 episodes on, 3 below."""
    gamma: float = 0.99
    """Table 1."""
    tau: float = 0.01
    """Table 1."""
    width: int = 64
    """Units of a hidden layer."""
    layers: int = 2
    """Hidden layers."""
    layer_norm: bool = True
    """Normalize hidden layers: features cannot grow without bound."""
    late_action: bool = True
    """The action joins the critic at its second layer, as in the original DDPG."""
    final_init: float | None = 3e-3
    """Last layers start within this, near the middle of the tanh; null: PyTorch's start."""
    critic_weight_decay: float = 1e-4
    """L2 decay of the critic. The original DDPG's 1e-2 holds Q well below the returns here."""
    reward_scale: float = 0.1
    """Factor of rewards in the loss, so that Q is of order one."""
    saturation_penalty: float = 1.0
    """Factor of the penalty on actions deep in the tanh's flat ends, where no gradient is."""
    saturation_limit: float = 1.5
    """Preactivations beyond this are penalized; tanh(1.5) = 0.905."""
    compile: bool = False
    """Make one program of an update with ``torch.compile``, which halves the time of a run. Needs a
    C++ compiler, and half a minute at the start, a few seconds the next time."""
    policy_delay: int = 1
    """DDPG and TD3: updates of the critics for one of the actor and the targets."""
    policy_noise: float = 0.0
    """DDPG and TD3: standard deviation of the noise that smooths the target."""
    noise_clip: float = 0.5
    """DDPG and TD3: bound of that noise."""
    alpha_init: float = 0.01
    """SAC: temperature of the entropy at the start, of rewards that are scaled."""
    alpha_lr: float = 3e-4
    """SAC: learning rate of its logarithm."""
    double: bool = True
    """DQN: whether the next action is that of the network, and not of the target network."""
    table_lr: float = 0.2
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
    """Whether the learner chooses among pairs of wheel speeds."""
    return learner.algorithm in ("dqn", "q_learning")


@dataclass
class ExplorationSettings:
    """Uniform actions at first, then Gaussian noise on the policy's, or some at random."""

    random_steps: int = 1_000
    """Steps of uniformly random actions."""
    sigma: float = 1.0
    """Standard deviation of the noise at the start."""
    sigma_end: float = 0.2
    """Standard deviation at the end; it does not vanish, as narrow data makes DDPG forget."""
    epsilon: float = 1.0
    """DQN and Q learning: chance of a random action at the start."""
    epsilon_end: float = 0.1
    """DQN and Q learning: chance at the end."""
    annealing_steps: int = 5_000
    """Steps from one to the other."""
    varied: bool = True
    """Whether each episode has a share of the noise, sampled uniformly from [0, 1]. With noise of
    one size the robot is thrown out of every loop, and never learns what a loop is worth."""


@dataclass
class Stage:
    """A number of episodes, or of actions, in one world or in the worlds of a generator."""

    world: str = "A"
    """``A``, ``B``, ``C``, ``D``, ``validation``, ``test``, the path of a world file, one world of
    a generator, as ``bars-7``, or a generator, as ``mixed``: a new world in each episode."""
    episodes: int = 0
    """Episodes; 0: the stage counts actions."""
    actions: int = 0
    """Actions of all robots together; 0: the stage counts episodes."""

    @property
    def length(self) -> int:
        """Episodes or actions, whichever it counts."""
        return self.episodes or self.actions


@dataclass
class CurriculumSettings:
    """Worlds one after the other."""

    name: str | None = None
    """Part of the run's folder and of its group in wandb; null: named after the stages."""
    stages: list[Stage] = field(default_factory=lambda: [Stage("A", episodes=100)])
    """All of them count episodes, or all of them count actions."""
    carry: bool = True
    """Whether networks and buffer carry on from world to world, or start anew."""


CURRICULA = {
    "A": [Stage("A", episodes=100)],
    "B": [Stage("B", episodes=200)],
    "C": [Stage("C", episodes=300)],
    "D": [Stage("D", episodes=400)],
    "paper": [Stage("A", 100), Stage("B", 200), Stage("C", 300), Stage("D", 400)],
    "rooms": [Stage("mixed", actions=100_000)],
}
"""The paper's episodes in each of its worlds, all of them one after the other, and new worlds."""
_LONGEST_NAME = 60


def curriculum_name(stages: Sequence[Stage]) -> str:
    """What a curriculum is called unless the user names it: after what is really run.

    Args:
        stages: The stages.

    Returns:
        The name of one of :data:`CURRICULA`, or worlds and episodes.

    Examples:
        >>> curriculum_name([Stage("A", 100)]), curriculum_name([Stage("A", 5), Stage("B", 7)])
        ('A', 'A5+B7')
    """
    for name, known in CURRICULA.items():
        if list(stages) == known:
            return name
    parts = [re.sub(r"[^\w.-]", "_", Path(s.world).stem) + str(s.length) for s in stages]
    whole = "+".join(parts)
    if len(whole) <= _LONGEST_NAME:
        return whole
    digest = hashlib.sha256(repr(list(stages)).encode()).hexdigest()[:8]
    return f"{parts[0][:20]}+{len(parts) - 1}-more-{digest}"


@dataclass
class EvaluationSettings:
    """Greedy episodes during training, which show how fast it learns and change nothing in it."""

    every: int = 0
    """Actions between two evaluations; 0: none."""
    world: str = "validation"
    """A world, or ``mixed:validation``: the validation worlds of a generator. Those of a test, by
    which nothing may be chosen, are refused with ``choose``."""
    episodes: int = 20
    """Fixed pairs of start and goal, others than those of ``evaluate.py --seed 0``."""
    choose: bool = False
    """Whether the policy of the run is the one that did best there, not the last one."""


@dataclass
class TrackingSettings:
    """Where the run is logged."""

    mode: str = "offline"
    """wandb: ``offline`` (no account), ``online`` or ``off``."""
    project: str = "torchrl-mpfa"
    log_every: int = 200
    """Actions between two entries of losses, weights and priorities."""


@dataclass
class TrainSettings:
    """A training run."""

    defaults: list[Any] = field(
        default_factory=lambda: [
            "_self_",
            {"method": "mpfa_per"},
            {"learner": "ddpg"},
            {"curriculum": "A"},
            {"tracking": "offline"},
            # After the learner: it has its values for all learners.
            {"regime": "rooms"},
            {"override hydra/job_logging": "none"},
        ]
    )
    hydra: Any = field(
        default_factory=lambda: {
            "run": {"dir": "${run_dir}"},
            "sweep": {
                "dir": "runs/sweep-${now:%Y-%m-%d_%H-%M-%S}",
                "subdir": "${hydra.job.override_dirname}",
            },
            # The run writes its settings itself, once it knows that the folder is its own.
            "output_subdir": None,
        }
    )
    run_dir: str = (
        "runs/${curriculum_name:${curriculum.name},${curriculum.stages}}"
        "-${method.name}-${learner.name}-${seed}"
    )
    """Folder of checkpoints, logs and pictures."""
    regime: str = "paper"
    """``regime=rooms``: many robots in new worlds; ``regime=paper``: Table 1, one robot, A to D."""
    seed: int = 0
    device: str = "cpu"
    """Where the networks are; the buffer stays in main memory."""
    threads: int = 1
    """Threads of PyTorch; with networks this small a second one gains nothing."""
    overwrite: bool = False
    """Whether to start anew in a folder that holds a run; its files are moved to ``previous/``."""
    resume: str | None = None
    """Folder of a run to continue, with its own settings. More episodes, tracking, threads and
    how often to evaluate and to save may be changed; anything else is refused."""
    checkpoint_every: int = 10_000
    """Actions between two checkpoints."""
    robots: int = 1
    """Robots that drive at once, each in a world of its own; those that are under way at the end of
    a stage give up their episodes."""
    updates: int = 1
    """Updates for one action of each robot."""
    method: Method = field(default_factory=Method)
    learner: LearnerSettings = field(default_factory=LearnerSettings)
    curriculum: CurriculumSettings = field(default_factory=CurriculumSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    exploration: ExplorationSettings = field(default_factory=ExplorationSettings)
    environment: EnvironmentSettings = field(default_factory=EnvironmentSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    assessment: AssessmentSettings = field(default_factory=AssessmentSettings)
    ray: RaySettings = field(default_factory=RaySettings)


REGIMES: dict[str, dict[str, Any]] = {
    "paper": {"regime": "paper", "defaults": [{"override /curriculum": "paper"}]},
    "rooms": {
        "regime": "rooms",
        "defaults": [{"override /curriculum": "rooms"}],
        "robots": 16,
        "updates": 4,
        "learner": {
            "actor_lr": 3e-4,
            "critic_lr": 3e-4,
            "tau": 0.002,
            # Without both a single critic's targets run ahead, and the robot circles.
            "policy_delay": 2,
            "policy_noise": 0.2,
        },
        "exploration": {"random_steps": 2_000, "annealing_steps": 20_000},
        "environment": {
            "physics": "kinematic",
            "progress": "shortest_path",
            "max_goal_distance": 20.0,
            # Without it there is no way out of a pocket, and a third of the mazes fail.
            "memory": "map",
            # Less than the paper's, as mazes and fields are narrow.
            "clearance": 0.05,
        },
        "evaluation": {"world": "mixed:validation", "episodes": 100},
    },
}
"""The paper's task and numbers, and what one would do today."""

GROUPS: dict[str, dict[str, Any]] = {
    "method": METHODS,
    "learner": {
        "ddpg": LearnerSettings,
        "td3": TD3Settings,
        "sac": SACSettings,
        "plain": PlainSettings,
        "dqn": DQNSettings,
        "q_learning": QLearningSettings,
    },
    "curriculum": {name: CurriculumSettings(stages=stages) for name, stages in CURRICULA.items()},
    "tracking": {
        "offline": TrackingSettings,
        "online": TrackingSettings(mode="online"),
        "off": TrackingSettings(mode="off"),
    },
    "regime": REGIMES,
}


def register() -> None:
    """Make the settings known to Hydra."""
    OmegaConf.register_new_resolver("curriculum_name", _resolve_name, replace=True)
    store = ConfigStore.instance()
    store.store(name="train", node=TrainSettings)
    for group, choices in GROUPS.items():
        package = "_global_" if group == "regime" else None
        for name, node in choices.items():
            store.store(group=group, name=name, node=node, package=package)


def _resolve_name(name: str | None, stages: Sequence[Any]) -> str:
    return name or curriculum_name([Stage(s.world, s.episodes, s.actions) for s in stages])


def as_settings(config: DictConfig | dict[str, Any]) -> TrainSettings:
    """Typed settings from what Hydra composed or a checkpoint holds.

    Args:
        config: The values; those that it lacks are the defaults.

    Returns:
        The settings, with the curriculum named.

    Raises:
        omegaconf.errors.OmegaConfBaseException: If a value is of another type, or unknown.
    """
    values = OmegaConf.create(config) if isinstance(config, dict) else config.copy()
    OmegaConf.set_struct(values, False)
    for name in ("defaults", "hydra"):
        values.pop(name, None)
    merged = OmegaConf.merge(OmegaConf.structured(TrainSettings), values)
    merged.pop("hydra", None)
    settings = OmegaConf.to_object(merged)
    assert isinstance(settings, TrainSettings)
    curriculum = settings.curriculum
    curriculum.name = curriculum.name or curriculum_name(curriculum.stages)
    return settings
