"""Settings of a training run: typed, in one place, each with its default and its reason.

Hydra builds its command line from these: ``train.py method=per learner.width=128 seed=3``. The
settings of a method are the fields of its class in :mod:`torchrl_mpfa.methods`; ``checks.py`` has
what settings may not be together.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from torchrl_mpfa.checks import NOT_NEGATIVE, SHARE, Rule
from torchrl_mpfa.methods import METHODS, MPFA, Method, method_named
from training.files import short_name
from training.settings.environment import EnvironmentSettings
from training.settings.learners import (
    DQNSettings,
    LearnerSettings,
    PlainSettings,
    QLearningSettings,
    SACSettings,
    TD3Settings,
)
from training.settings.rules import (
    NAME,
    WORD,
    at_least,
    between,
    choice,
    named,
    setting,
    up_to,
)

MOST_ROBOTS = 4096
"""On wheels these take 6.4 GB."""
LAST_SEED = 2**32 - 1
"""Each stage has a seed of its own, a million times as large, which is to fit in 64 bits."""
_GROUP: Rule = (lambda value: 0 < len(value) <= 128, "a word of at most 128 letters")


@dataclass
class ExplorationSettings:
    """Uniform actions at first, then Gaussian noise on the policy's, or some at random."""

    random_steps: int = setting(1_000, at_least(0))
    """Steps of uniformly random actions."""
    sigma: float = setting(1.0, NOT_NEGATIVE)
    """Standard deviation of the noise at the start."""
    sigma_end: float = setting(0.2, NOT_NEGATIVE)
    """Standard deviation at the end; it does not vanish, as narrow data makes DDPG forget."""
    epsilon: float = setting(1.0, SHARE)
    """DQN and Q learning: chance of a random action at the start."""
    epsilon_end: float = setting(0.1, SHARE)
    """DQN and Q learning: chance at the end."""
    annealing_steps: int = setting(5_000, at_least(1))
    """Steps in which the noise, or the chance, goes from its start to its end."""
    varied: bool = True
    """True if each episode has a random share of the noise. Noise of one size throws the robot out
    of every loop."""


@dataclass
class Stage:
    """A number of episodes, or of actions, in one world or in the worlds of a generator."""

    world: str = "A"
    """``A`` to ``D``, ``validation``, ``test``, a world file, one world of a generator, as
    ``bars-7``, or a generator, as ``mixed``: a new world in each episode."""
    episodes: int = 0
    """Episodes; 0: the stage counts actions."""
    actions: int = 0
    """Actions of all robots together; 0: the stage counts episodes."""

    @property
    def length(self) -> int:
        """Episodes or actions, whichever it counts."""
        return self.episodes or self.actions


def sized(stages: Sequence[Stage], actions: int) -> list[Stage]:
    """Return stages that count actions, in the proportion of their lengths.

    Args:
        stages: The stages, which count episodes or actions; without a length each counts as 1.
        actions: Actions of all robots in all stages.

    Raises:
        ValueError: If a stage would have no action.

    Examples:
        >>> [each.actions for each in sized([Stage("A", episodes=100), Stage("B", 200)], 6_000)]
        [2000, 4000]
    """
    so_far = list(accumulate(stage.length or 1 for stage in stages))
    ends = [actions * each // so_far[-1] for each in so_far]
    lengths = [end - begin for begin, end in pairwise([0, *ends])]
    if any(length < 1 for length in lengths):
        raise ValueError(f"actions must leave each stage at least 1, got {actions}")
    return [Stage(each.world, actions=n) for each, n in zip(stages, lengths, strict=True)]


@dataclass
class CurriculumSettings:
    """Worlds one after the other."""

    name: str | None = setting(None, NAME)
    """Part of the run's folder and of its group in wandb; null: named after the stages."""
    stages: list[Stage] = field(default_factory=lambda: [Stage("A", episodes=100)])
    """The worlds in their order; all of them count episodes, or all of them count actions."""
    carry: bool = True
    """True if networks and buffer are kept from world to world; learning rates, beta and random
    steps follow the whole run in either case."""


CURRICULA = {
    "A": [Stage("A", episodes=100)],
    "B": [Stage("B", episodes=200)],
    "C": [Stage("C", episodes=300)],
    "D": [Stage("D", episodes=400)],
    "paper": [Stage("A", 100), Stage("B", 200), Stage("C", 300), Stage("D", 400)],
    "rooms": [Stage("mixed", actions=30_000)],
}
"""The paper's episodes in each of its worlds, all of them one after the other, and new worlds."""
_LONGEST_NAME = 60


def curriculum_name(stages: Sequence[Stage]) -> str:
    """Return the default name of a curriculum, after the stages that are run.

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

    every: int = setting(0, at_least(0))
    """Actions between two evaluations; 0: none."""
    world: str = "validation"
    """A world, ``mixed:validation``: the validation worlds of a generator, or ``same``: where the
    last stage is; of ``mixed``, in ``mazes``. Test worlds are rejected with ``choose``."""
    episodes: int = setting(20, at_least(1))
    """Fixed pairs of start and goal, others than those of ``evaluate.py --seed 0``."""
    choose: bool = False
    """True if the policy of the run is the best there, not the last."""


@dataclass
class TrackingSettings:
    """Logs of the run; ``tracking=[wandb,csv]`` names several."""

    mode: str = setting("off", choice("offline", "online", "off"))
    """wandb: ``offline`` (no account), ``online`` or ``off``."""
    csv: bool = False
    """True if TorchRL's CSVLogger writes a file for each number, to ``csv/``."""
    tensorboard: bool = False
    """True if TorchRL's TensorboardLogger writes to ``tensorboard/``."""
    project: str = setting("torchrl-mpfa", WORD)
    """wandb: the project."""
    group: str | None = setting(None, _GROUP)
    """wandb: what the runs of a kind have in common; null: CURRICULUM-METHOD-LEARNER."""
    log_every: int = setting(200, at_least(1))
    """Actions between two entries of losses, weights and priorities."""
    pictures_every: int | None = setting(0, at_least(0))
    """Actions between two sets of pictures of the policy, for wandb and TensorBoard; 0: one set at
    the end, and the paths of each evaluation; null: none."""


@dataclass
class TrainSettings:
    """A training run."""

    defaults: list[Any] = field(
        default_factory=lambda: [
            "_self_",
            {"method": "mpfa_per"},
            {"learner": "ddpg"},
            {"curriculum": "A"},
            {"tracking": "wandb"},
            # After the learner: it has its values for all learners.
            {"regime": "rooms"},
            {"override hydra/job_logging": "none"},
        ]
    )
    hydra: Any = field(
        default_factory=lambda: {
            "job": {"name": "train"},
            "run": {"dir": "${run_dir}"},
            "sweep": {
                "dir": "runs/sweep-${now:%Y-%m-%d_%H-%M-%S}",
                "subdir": "${one_folder:${hydra.job.override_dirname}}",
            },
            # The run writes its settings itself, once it knows that the folder is its own.
            "output_subdir": None,
        }
    )
    run_dir: str = setting(
        "runs/${curriculum_name:${curriculum.name},${curriculum.stages},${actions}}"
        "-${method.name}-${learner.name}-${seed}",
        WORD,
    )
    """Folder of checkpoints, logs and pictures."""
    regime: str = "paper"
    """``regime=rooms``: many robots in new worlds; ``regime=paper``: Table 1, one robot, A to D."""
    seed: int = setting(0, between(0, LAST_SEED, f"from 0 to {LAST_SEED}"))
    """Seed of the networks, the exploration, the replay and the generated worlds."""
    device: str = "cpu"
    """Device of the networks; the buffer stays in main memory."""
    threads: int = setting(1, up_to(1024))
    """Threads of PyTorch, on which the last bits of a network depend. Small networks gain nothing
    by a second."""
    overwrite: bool = False
    """True to start again in a folder that holds a run; its files are moved to ``previous/``."""
    resume: str | None = None
    """Folder of a run to continue, with its own settings. More episodes, tracking and how
    often to evaluate and to save may be changed; anything else is rejected."""
    actions: int | None = setting(None, at_least(1))
    """Length of the run: actions of all robots in all stages, which share them in the proportion of
    their lengths, also where these count episodes; null: as ``curriculum.stages`` says."""
    plugin: str | None = setting(None, WORD)
    """Python file that is imported first: it may register methods, signals, robots and generators.
    A resumed run must be given it again."""
    checkpoint_every: int = setting(10_000, at_least(1))
    """Actions between two checkpoints."""
    robots: int = setting(1, up_to(MOST_ROBOTS, why=", as a robot takes up to 1.6 MB of memory"))
    """Robots that drive at once, each in a world of its own; episodes in progress at the end of a
    stage are given up."""
    updates: int = setting(1, at_least(1))
    """Updates for one action of each robot."""
    method: Method = field(default_factory=MPFA)
    """One of the methods by name; its settings can be changed one by one."""
    learner: LearnerSettings = field(default_factory=LearnerSettings)
    """``ddpg``, ``td3``, ``sac``, ``plain``, ``dqn`` or ``q_learning``."""
    curriculum: CurriculumSettings = field(default_factory=CurriculumSettings)
    """``A``, ``B``, ``C`` or ``D``: a world of the paper; ``paper``: all four; or ``rooms``."""
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    """``wandb`` (or ``offline``), ``online``, ``tensorboard``, ``csv``, or several of them as
    ``[wandb,csv]``; or ``off``."""
    exploration: ExplorationSettings = field(default_factory=ExplorationSettings)
    environment: EnvironmentSettings = field(default_factory=EnvironmentSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)


SAME = "same"
"""Evaluations in worlds such as those of the training."""
HARDEST = {"mixed": "mazes"}
"""Worlds in which policies that do well in a mixture of worlds still differ."""
REGIMES: dict[str, dict[str, Any]] = {
    "paper": {
        "regime": "paper",
        "defaults": [{"override /curriculum": "paper"}],
        "environment": {"max_steps": 500},
    },
    "rooms": {
        "regime": "rooms",
        "defaults": [{"override /curriculum": "rooms"}],
        "robots": 16,
        "updates": 4,
        "learner": {
            "actor_lr": 3e-4,
            "critic_lr": 3e-4,
            "tau": 0.005,
            # With 0.99 the robot is more careful than it needs to be, hence slower.
            "gamma": 0.95,
            # Without both a single critic's targets run ahead, and the robot circles.
            "policy_delay": 2,
            "policy_noise": 0.4,
            "noise_clip": 0.8,
            "full_range": True,
        },
        "exploration": {"random_steps": 2_000, "annealing_steps": 20_000},
        "environment": {
            # The paper's robot can neither stop nor reverse; its body with its real wheels can.
            "robot": "kobuki",
            # What a slow robot does in 0.2 s changes too little to learn from.
            "action_repeat": None,
            # The policy is to drive with it, so that it may pass close by.
            "filter": 1.0,
            "step_cost": 0.05,
            "physics": "kinematic",
            "progress": "shortest_path",
            "max_goal_distance": 20.0,
            # Without it there is no way out of a pocket, and a third of the mazes fail.
            "memory": "map",
            # Less than the paper's, as mazes and fields are narrow. The filter lets a robot pass
            # by at 0.01 m, so that episodes still end, which keeps policies from doing so.
            "clearance": 0.02,
        },
        # A single critic may run away after it was good: one seed of ten ended at half.
        "evaluation": {
            "world": SAME,
            "episodes": 100,
            "every": 5_000,
            "choose": True,
        },
    },
}
"""The paper's task and numbers, and what one would do today."""

SEVERAL = "tracking"
"""The group of which a run may have several choices: each says what it has beyond the others."""
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
        "wandb": {"mode": "offline"},
        "offline": {"mode": "offline"},
        "online": {"mode": "online"},
        "tensorboard": {"tensorboard": True},
        "csv": {"csv": True},
        "off": {},
    },
    "regime": REGIMES,
}


@cache
def _one_folder(settings: str) -> str:
    """Return the name of the folder of a run, in which a value may be a path, or all too long."""
    return short_name(settings.replace("/", "_"))


def register() -> None:
    """Make the settings known to Hydra; a second call changes nothing."""
    OmegaConf.register_new_resolver("curriculum_name", _resolve_name, replace=True)
    OmegaConf.register_new_resolver("one_folder", _one_folder, replace=True)
    store = ConfigStore.instance()
    # The settings that every method has: those of the chosen one come on top.
    store.store(name="train", node=TrainSettings(method=Method()))
    for group, choices in GROUPS.items():
        package = "_global_" if group == "regime" else None
        for name, node in choices.items():
            store.store(group=group, name=name, node=node, package=package)


def _resolve_name(name: str | None, stages: Sequence[Any], actions: int | None) -> str:
    made = _plain(stages)
    return name or curriculum_name(sized(made, actions) if actions else made)


def _plain(stages: Sequence[Any]) -> list[Stage]:
    return [Stage(each.world, each.episodes, each.actions) for each in stages]


def _without_file(robot: Any) -> Any:
    """Return a robot's name as it is, and the values of a file in its place."""
    from mpfa_envs.robots.resolve import is_robot_file, resolve_robot

    if isinstance(robot, str) and not is_robot_file(robot):
        return robot
    with named("environment.robot: "):
        return asdict(resolve_robot(robot))


def as_settings(config: DictConfig | dict[str, Any]) -> TrainSettings:
    """Return typed settings from Hydra's composition or a checkpoint."""
    values = OmegaConf.create(config) if isinstance(config, dict) else config.copy()
    OmegaConf.set_struct(values, False)
    for name in ("defaults", "hydra"):
        values.pop(name, None)
    structure = OmegaConf.structured(TrainSettings)
    if "method" in values:
        # Each method has settings of its own: its name says which.
        structure.method = method_named(values.method.name)
    merged = OmegaConf.merge(structure, values)
    merged.pop("hydra", None)
    if merged.actions is not None:
        # From here on the stages alone say how long the run is.
        merged.curriculum.stages = sized(_plain(merged.curriculum.stages), merged.actions)
        merged.actions = None
    # A method checks its own settings.
    with named("method."):
        settings = OmegaConf.to_object(merged)
    assert isinstance(settings, TrainSettings)
    settings.environment.robot = _without_file(settings.environment.robot)
    curriculum = settings.curriculum
    curriculum.name = curriculum.name or curriculum_name(curriculum.stages)
    if settings.evaluation.world == SAME and curriculum.stages:
        # Generators take a second to import, and are none of what a setting is.
        from mpfa_envs import GENERATORS

        last = curriculum.stages[-1].world
        known = last in GENERATORS
        settings.evaluation.world = f"{HARDEST.get(last, last)}:validation" if known else last
    return settings


def plain_settings(settings: TrainSettings) -> dict[str, Any]:
    """Return the settings as plain values, without those of Hydra."""
    return {k: v for k, v in asdict(settings).items() if k not in ("defaults", "hydra")}
