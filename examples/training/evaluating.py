"""Evaluations of a policy in the worlds of a command line, and the names of their folders."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, field
from importlib import import_module
from itertools import accumulate
from typing import Any

from mpfa_envs import (
    Policy,
    RobotNoise,
    TaskConfig,
    VectorNavigationEnv,
    WorldTask,
    run_tasks,
    summarize,
    world_tasks,
)
from mpfa_envs.control.rescue import Rescued
from mpfa_envs.driver import Filtered
from mpfa_envs.evaluation.results import EpisodeResult
from mpfa_envs.evaluation.runs import ENVS_AT_ONCE
from mpfa_envs.planners import DynamicWindow, MapPlanner, PredictiveControl
from mpfa_envs.robots.drives import SERVERS
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.safety.filter import CLEARANCE
from training.files import short_name
from training.worlds import worlds_label

_AS_TRAINED = (
    "plan", "goal_radius", "filter", "noise", "latency", "robot", "team", "right_of_way", "rescue"
)  # fmt: skip
"""Conditions that an evaluation has no entry of where they are as in the training."""
Drivable = Policy | MapPlanner | DynamicWindow | PredictiveControl | Filtered
"""Drivers of a robot, with the ``env_arguments`` that they need."""


@dataclass(frozen=True)
class Drives:
    """Episodes of a policy in one world, or in the worlds of a generator."""

    tasks: list[WorldTask]
    results: list[EpisodeResult]
    trails: list[list[tuple[float, float]]]
    """Positions of the robot in each episode [m]."""

    def of_world(self, name: str) -> list[int]:
        """Return the numbers of the episodes in one world."""
        return [n for n, each in enumerate(self.tasks) if each.world.name == name]


def check_physics(physics: str) -> None:
    """Raise for simulated wheels if there is no PyBullet."""
    if physics == "wheels":
        try:
            import_module("mpfa_envs.robots.simulation")
        except ImportError as error:
            raise ValueError(str(error)) from error


@dataclass(frozen=True)
class Conditions:
    """Worlds, tasks, physics and errors of an evaluation: its folder and its settings name them."""

    words: tuple[str, ...]
    """Worlds, as on the command line."""
    physics: str
    """``wheels`` or ``kinematic``."""
    episodes: int | None = None
    seed: int = 0
    noise: RobotNoise | None = None
    latency: float | None = None
    """Time from a scan to the moment at which the wheels take the order [s]."""
    filtered: bool = False
    approach: float = 0.0
    """Speed of what may come, before which the filter has the robot stand [m/s]."""
    robot: RobotModel | None = None
    """Another robot than that of the training."""
    task: Mapping[str, Any] = field(default_factory=dict)
    """``plan`` and ``goal_radius``, where they are others than in the training."""
    team: int = 1
    """Robots in a world."""
    right_of_way: bool = False
    """True if robots wait for those of a lower number."""
    rescue: bool = False
    """True if predictive control leads a robot on that stands still again."""

    @property
    def folder(self) -> str:
        """Name of the folder of the results: each choice has its own.

        Examples:
            >>> Conditions(("test", "bars:test"), "wheels", noise=RobotNoise(slip=0.1)).folder
            'evaluation-test+bars-test-wheels-slip0.1'
        """
        errors = {**(asdict(self.noise) if self.noise else {}), "latency": self.latency}
        parts = [
            f"evaluation-{worlds_label(self.words)}-{self.physics}",
            "-filter" if self.filtered else "",
            f"-approach{self.approach:g}" if self.approach else "",
            "-rescue" if self.rescue else "",
            f"-{self.robot.name}" if self.robot is not None else "",
            *(f"-{name}-{value}" for name, value in self.task.items()),
            f"-team{self.team}" if self.team > 1 else "",
            "-right-of-way" if self.right_of_way else "",
            f"-seed{self.seed}" if self.seed else "",
            *(f"-{name}{value:g}" for name, value in errors.items() if value),
        ]
        return short_name("".join(parts))

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of the environments."""
        errors = {"noise": self.noise, "latency": self.latency}
        return {**errors, "physics": self.physics, **self.task}

    @property
    def filter_arguments(self) -> dict[str, float]:
        """Arguments of the filter; those that are off are left out."""
        return {"clearance": CLEARANCE} | ({"approach": self.approach} if self.approach else {})

    def as_json(self) -> dict[str, Any]:
        """Return the entries of ``settings.json``; what is as in the training has none."""
        tasks = {"episodes": self.episodes, "seed": self.seed, "physics": self.physics}
        others = {
            "filter": self.filter_arguments if self.filtered else None,
            "noise": self.noise and asdict(self.noise),
            "latency": self.latency,
            "robot": self.robot and asdict(self.robot),
            "team": self.team if self.team > 1 else None,
            "right_of_way": self.right_of_way or None,
            "rescue": self.rescue or None,
        }
        document = {"words": list(self.words), **tasks, **self.task}
        return document | {name: value for name, value in others.items() if value is not None}

    def are_of(self, settings: Mapping[str, Any]) -> bool:
        """Return True if the ``settings.json`` of an evaluation has these conditions."""
        mine = json.loads(json.dumps(self.as_json()))
        return all(settings.get(name) == mine.get(name) for name in (*mine, *_AS_TRAINED))


def on_robot(policy: Policy, robot: RobotChoice | None) -> Policy:
    """Put a policy on another robot than it was trained on; None: leave it where it is.

    Raises:
        ValueError: If there is no such robot, or it senses another number of values.
    """
    if robot is None:
        return policy
    robot, known = resolve_robot(robot), TaskConfig(**policy.env_arguments)
    moved = copy(policy)
    # The lidar saturates as far from the rim as it did.
    near = known.closeness_distance - known.robot.lidar_to_rim + robot.lidar_to_rim
    changes = {"robot": asdict(robot), "closeness_distance": round(near, 9)}
    moved.env_arguments = {**policy.env_arguments, **changes}
    parts = TaskConfig(**moved.env_arguments).observation_slices
    senses = max(part.stop for part in parts.values())
    if senses != policy.observation_size:
        raise ValueError(
            f"--robot must sense {policy.observation_size} values as {known.robot.name!r} does, "
            f"got {senses} of {robot.name!r}: train a policy with environment.robot"
        )
    return moved


def filtered(
    policy: Drivable, *, approach: float = 0.0, rescue: bool = False, **env_arguments: Any
) -> Filtered:
    """Put a policy behind the filter that keeps the robot off obstacles that its lidar sees."""
    config = TaskConfig(**policy.env_arguments | env_arguments)
    driver = Rescued(policy) if rescue else policy
    return Filtered(driver, config.make_filter(approach=approach))


def needs_filter(policy: Drivable) -> bool:
    """Return True if a policy has never driven without the filter, as its card says."""
    return bool(getattr(policy, "card", {}).get("filter", False))


def as_trained(policy: Policy) -> Policy | Filtered:
    """Put a policy behind the filter if it needs that."""
    return filtered(policy) if needs_filter(policy) else policy


def tasks_of(
    policy: Drivable, worlds: Sequence[str], *, episodes: int | None, seed: int
) -> list[WorldTask]:
    """Return the fixed tasks of some worlds, for the robot of a policy."""
    robot = policy.env_arguments.get("robot", "turtlebot2")
    return [
        task
        for world in worlds
        for task in world_tasks(world, episodes=episodes, seed=seed, robot=robot)
    ]


def drive(
    policy: Drivable,
    worlds: Sequence[str],
    *,
    episodes: int | None,
    seed: int,
    physics: str | None,
    noise: RobotNoise | None = None,
    latency: float | None = None,
    progress: bool,
    **task: Any,
) -> list[Drives]:
    """Drive a policy through fixed tasks of each world, as :func:`mpfa_envs.evaluate`.

    Contact is the only collision, and ``task`` has further arguments. Return tasks, results and
    paths of each world; these do not depend on the other worlds.
    """
    arguments: dict[str, Any] = {**policy.env_arguments, "noise": noise, "latency": latency}
    arguments |= task
    if physics is not None:
        arguments["physics"] = physics
    sets = [tasks_of(policy, [each], episodes=episodes, seed=seed) for each in worlds]
    # A robot continues with the next world while the slowest of this one still drive. Robots on
    # wheels that share a physics server must be the same ones as if there was no other world.
    apart = arguments.get("physics") != "kinematic" and max(map(len, sets)) > SERVERS
    driven: list[Drives] = []
    for group in [[each] for each in sets] if apart else [sets]:
        driven += drive_together(policy, group, progress=progress, **arguments)
    return driven


def drive_together(
    policy: Drivable, sets: Sequence[list[WorldTask]], *, progress: bool, **arguments: Any
) -> list[Drives]:
    """Drive sets of tasks by as many robots as the largest of them has."""
    tasks = [task for each in sets for task in each]
    trails: list[list[tuple[float, float]]] = [[]] * len(tasks)

    def keep(env: VectorNavigationEnv, robot: int, number: int) -> None:
        trails[number] = env.trail(robot)

    robots = min(ENVS_AT_ONCE, max(map(len, sets)))
    results = run_tasks(
        policy, tasks, envs_at_once=robots, progress_bar=progress, on_end=keep, **arguments
    )
    ends = list(accumulate(map(len, sets)))
    parts = [slice(end - len(each), end) for end, each in zip(ends, sets, strict=True)]
    return [Drives(tasks[part], results[part], trails[part]) for part in parts]


def summary_row(results: Sequence[EpisodeResult]) -> dict[str, float]:
    """Estimates of :func:`mpfa_envs.summarize` with the ends of their intervals, as one row."""
    row: dict[str, float] = {"episodes": len(results)}
    for name, interval in summarize(results).items():
        row |= {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
    return row
