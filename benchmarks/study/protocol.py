"""The study as data: what a table is, and the tasks and settings that tables share.

Tables A to D are in ``designs.py``, experiments, tables H to L, in ``experiments.py``; table F, off
navigation, is in ``gym/table.py``, table G, value learning, in ``benchmarks/values``.

Arms that two tables have in common are trained once: runs with the same task and settings have one
folder, whatever table asks for them. Settings were chosen with seeds from 1000 on and validation
worlds alone; the seeds of the tables begin at :data:`FIRST_SEED`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from training.comparison.jobs import Comparison, Evaluation, Job

ROOT = Path("runs/study")
"""Folder of the study unless a command line says otherwise."""
FIRST_SEED = 100
COMMON = (
    "regime=rooms",
    "updates=2",
    "learner.compile=true",
    "tracking=off",
    "evaluation.every=2000",
    "evaluation.world=mixed:validation",
    "evaluation.episodes=40",
    "evaluation.choose=false",
    # The paper's robot, without what the regime has for others.
    "environment.robot=turtlebot2",
    "environment.filter=0",
    "environment.step_cost=0",
)
"""Settings of all tables but A."""
SPARSE = (
    *COMMON,
    "curriculum.stages=[{world: mixed, actions: 24000}]",
    # With the regime's slower targets nothing is learned from the goal alone in so few actions.
    "learner.tau=0.01",
    "learner.gamma=0.97",
    "environment.progress=none",
    "environment.max_goal_distance=6",
    "environment.detour_chance=0",
)
"""The goal and the collision alone are rewarded."""
DENSE = (*COMMON, "curriculum.stages=[{world: mixed, actions: 40000}]")
"""Rewards, distances and targets of the regime."""
VOLUMES = {
    8: ("robots=32", "updates=1"),
    32: ("robots=16", "updates=2"),
    128: ("robots=16", "updates=8"),
    256: ("robots=16", "updates=16"),
}
"""Settings by replay volume: transitions that are learned from for each action, of 256 an update.

:data:`SPARSE` and :data:`DENSE` have 32.
"""
GENERATORS = ("rooms", "clutter", "bars", "fields", "halls", "mazes")
TEST = Evaluation(tuple(f"{name}:test" for name in GENERATORS), 20, "wheels")
"""What last policies are asked to do."""

HEIGHT = "greedy success in validation"
"""What is over actions in the curves of all tables but F."""
Pair = tuple[str, str]
"""Labels of two arms: the first less the second."""


@dataclass(frozen=True)
class Table:
    """A question, and the runs that answer it."""

    name: str
    question: str
    comparisons: tuple[Comparison, ...]
    planned: tuple[Pair, ...]
    """Comparisons that are corrected for each other."""
    explored: tuple[Pair, ...]
    """All others, corrected for each other."""
    panels: dict[str, tuple[str, ...]]
    """Arms that are shown together, by the title of their panel."""
    primary: str = "area"
    """The measure by which it is decided: ``area`` or ``success``."""
    kinds: tuple[str, ...] = TEST.words
    """Kinds of worlds in which the success of last policies counts, each of them the same."""
    height: str = HEIGHT
    """What is over actions in its curves, between 0 and 1."""
    note: str = "Success is that of the last policy, each kind of worlds counting the same."
    """What else its page says of the measures."""


def label_of(job: Job, root: Path) -> str:
    """What the arm of a run is called in the study: its folder, learner, method and arm.

    Examples:
        >>> label_of(Job("td3", "per", 100, Path("runs/study/sparse")), Path("runs/study"))
        'sparse/td3/per'
    """
    folder = job.folder.relative_to(root).as_posix()
    return "/".join(part for part in (folder, job.learner, job.method, job.arm.name) if part)


def short_names(labels: Sequence[str]) -> dict[str, str]:
    """Labels without the parts that all of them begin or end with.

    Examples:
        >>> list(short_names(["sparse/td3/per/v8", "sparse/td3/lap/v8"]).values())
        ['per', 'lap']
        >>> list(short_names(["sparse/td3/per", "sparse/td3/per/v8"]).values())
        ['per', 'per/v8']
    """
    parts = [label.split("/") for label in labels]
    for end in (0, -1):
        while all(len(each) > 1 and each[end] == parts[0][end] for each in parts):
            parts = [each[1:] if end == 0 else each[:-1] for each in parts]
    return {label: "/".join(part) for label, part in zip(labels, parts, strict=True)}


def seeds_of(number: int) -> range:
    """So many seeds of the tables."""
    return range(FIRST_SEED, FIRST_SEED + number)


def pairs_of(prefix: str, *pairs: str, suffix: str = "") -> tuple[Pair, ...]:
    """Labels out of ``"per-uniform"`` and the like."""
    named = (pair.split("-") for pair in pairs)
    return tuple((f"{prefix}/{a}{suffix}", f"{prefix}/{b}{suffix}") for a, b in named)


def arms_of(prefix: str, *methods: str, suffix: str = "") -> tuple[str, ...]:
    """Labels of methods of one task and learner."""
    return tuple(f"{prefix}/{method}{suffix}" for method in methods)
