"""The study as data: tables A to D, each a question, its runs, and what is compared in it.

Table F, off navigation, is in ``gym/table.py``, table G, value learning, in ``benchmarks/values``.

Arms that two tables have in common are trained once: runs with the same task and settings have one
folder, whatever table asks for them. Settings were chosen with seeds from 1000 on and validation
worlds alone; the seeds of the tables begin at :data:`FIRST_SEED`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from benchmarks.study.paper import NAMES, TABLE_2, TABLE_4, Tested, comparisons
from torchrl_mpfa.methods import METHODS
from torchrl_mpfa.methods.catalogue import ALIASES
from training.comparison.arms import PLAIN, Arm
from training.comparison.jobs import TESTED, Comparison, Evaluation, Job

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

KEY = ("uniform", "per", "mpfa_per", "mpf_per", "mpfa_plus", "lap", "la3p", "uniform_halves")
FULL = ("uniform", "per", "mpfa_per", "mpf_per", "mpfa_plus", "lap", "pal")
"""Methods that have twenty seeds with sparse rewards."""
OF_VOLUMES = {
    8: ("uniform", "per", "mpfa_per"),
    32: ("uniform", "per", "mpfa_per", "mpfa_plus", "lap", "geometric"),
    128: ("uniform", "per", "mpfa_per", "mpfa_plus", "lap", "geometric"),
    256: ("uniform", "per", "mpfa_per", "mpfa_plus"),
}
"""Methods by replay volume."""
EVERY = tuple(
    name for name, made in METHODS.items() if name not in ALIASES.values() and not made.hindsight
)
"""Methods of the catalogue by the name that fits all learners, but goals in hindsight, with which a
run learns from more than its robots did."""

PAPER = ("regime=paper", "robots=16", "updates=16", "learner.compile=true", "tracking=off")
"""The paper's task with the same replay volume and sixteen robots in the place of one."""
LETTER = Arm(
    "letter",
    ("environment.mirror=false", "environment.clearance=0.17", "exploration.varied=false"),
)
"""With ``learner=plain`` the paper to the letter: 0.35 m from the robot's center is a collision."""
ONE_ROBOT = Arm("one_robot", ("robots=1", "updates=1"))
UNSEEN = Evaluation(("rooms:100-109", "bars:test"), 40)
"""Where the policies of table A are tested beside the test world."""

MEDIAN = Arm("median", ("method.floor_quantile=0.5",))
"""LAP whose floor is the median of the TD errors: it was added once LAP as published had lost."""

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


def paper_comparisons(table: Table) -> tuple[Comparison, ...]:
    """Those of table A that the paper's own figures and tables are made of."""
    return tuple(
        comparison
        for comparison in table.comparisons
        if comparison.learners == ("ddpg",)
        and comparison.evaluation == TESTED
        and comparison.arms != (ONE_ROBOT,)
    )


def tables(root: Path, *, most: int | None = None) -> dict[str, Table]:
    """The tables, in the order in which they are run.

    Examples:
        >>> [len(table.comparisons) for table in tables(Path("runs/study")).values()]
        [4, 6, 8, 1]
    """
    if most is not None and most < 1:
        raise ValueError(f"most must be at least 1, got {most}")
    made = (_table_c(root), _table_d(root), _table_a(root), _table_b(root))
    return {table.name: _at_most(table, most) for table in made}


def _at_most(table: Table, most: int | None) -> Table:
    return replace(
        table,
        comparisons=tuple(replace(each, seeds=each.seeds[:most]) for each in table.comparisons),
    )


def _seeds(number: int) -> range:
    return range(FIRST_SEED, FIRST_SEED + number)


def _pairs(prefix: str, *pairs: str, suffix: str = "") -> tuple[Pair, ...]:
    """Labels out of ``"per-uniform"`` and the like."""
    named = (pair.split("-") for pair in pairs)
    return tuple((f"{prefix}/{a}{suffix}", f"{prefix}/{b}{suffix}") for a, b in named)


_FIVE = (
    "per-uniform",
    "mpfa_per-uniform",
    "mpfa_per-per",
    "mpfa_plus-per",
    "mpfa_plus-mpfa_per",
)
_SIX = (*_FIVE, "mpf_per-per")
_CONTROLS = ("mpfa_plus-uniform", "lap-uniform", "la3p-uniform_halves")


def _arms(prefix: str, *methods: str, suffix: str = "") -> tuple[str, ...]:
    return tuple(f"{prefix}/{method}{suffix}" for method in methods)


def _table_c(root: Path) -> Table:
    folder, seeds = root / "sparse", _seeds(20)
    planned = {tuple(pair.split("-")) for pair in _SIX}
    others = [
        f"{a}-{b}"
        for b in ("uniform", "per")
        for a in EVERY
        # What is planned, or its reverse, is none of these.
        if a not in ("uniform", "per") and not {(a, b), (b, a)} & planned
    ]
    rest = [name for name in EVERY if name not in KEY]
    few = tuple(name for name in EVERY if name not in FULL)
    return Table(
        "C",
        "Sparse reward: does any priority learn faster than uniform replay, and MPFA-PER than PER?",
        (
            Comparison(folder, FULL, SPARSE, seeds, ("td3",), evaluation=TEST),
            Comparison(folder, few, SPARSE, _seeds(10), ("td3",), evaluation=TEST),
            Comparison(folder, KEY, SPARSE, _seeds(10), ("ddpg",), evaluation=TEST),
            Comparison(folder, ("lap",), SPARSE, seeds, ("td3",), (MEDIAN,), TEST),
        ),
        _pairs("sparse/td3", *_SIX),
        (
            *_pairs("sparse/td3", *others, "la3p-uniform_halves"),
            *(
                ("sparse/td3/lap/median", f"sparse/td3/{other}")
                for other in ("lap", "per", "uniform")
            ),
            *_pairs("sparse/ddpg", *_SIX, *_CONTROLS),
        ),
        {
            "TD3": _arms("sparse/td3", *KEY, "lap/median"),
            "DDPG": _arms("sparse/ddpg", *KEY),
            "TD3, more of the paper's": _arms(
                "sparse/td3", "uniform", "per", *(n for n in rest if n in NAMES)
            ),
            "TD3, others": _arms(
                "sparse/td3", "uniform", "per", *(n for n in rest if n not in NAMES)
            ),
        },
    )


def _table_d(root: Path) -> Table:
    folder, at = root / "sparse", "sparse/td3"

    def of(volume: int, methods: Sequence[str], seeds: int) -> Comparison:
        arms = (PLAIN,) if volume == 32 else (Arm(f"v{volume}", VOLUMES[volume]),)
        return Comparison(folder, tuple(methods), SPARSE, _seeds(seeds), ("td3",), arms, TEST)

    ends = {volume: "" if volume == 32 else f"/v{volume}" for volume in OF_VOLUMES}
    first = OF_VOLUMES[8]
    return Table(
        "D",
        "Replay volume: how often must transitions be replayed for priorities to pay?",
        (
            of(8, first, 20),
            of(32, OF_VOLUMES[32][:-1], 20),
            of(32, OF_VOLUMES[32][-1:], 10),
            of(128, first, 20),
            of(128, OF_VOLUMES[128][len(first) :], 10),
            of(256, OF_VOLUMES[256], 10),
        ),
        # Those of volume 32 are in table C, and corrected there.
        (
            *_pairs(at, *_FIVE[:3], suffix=ends[8]),
            *(pair for volume in (128, 256) for pair in _pairs(at, *_FIVE, suffix=ends[volume])),
        ),
        (
            *_pairs(at, "mpfa_plus-uniform", "lap-uniform", "geometric-uniform", suffix=ends[128]),
            *_pairs(at, "mpfa_plus-uniform", suffix=ends[256]),
        ),
        {
            f"sparse, volume {volume}": _arms(at, *methods, suffix=ends[volume])
            for volume, methods in OF_VOLUMES.items()
        },
    )


def _table_a(root: Path) -> Table:
    folder = root / "paper"
    first = ("mpfa_per", "per", "uniform")
    _, phi = comparisons(folder, seeds=10)
    phi = replace(phi, settings=(*PAPER, *phi.settings[1:]), seeds=_seeds(10))
    tested = (
        Comparison(folder, first, PAPER, _seeds(10)),
        Comparison(folder, tuple(n for n in NAMES if n not in first), PAPER, _seeds(10)),
        Comparison(folder, first, PAPER, _seeds(10), ("plain",), (LETTER,)),
    )
    unseen = tuple(replace(comparison, evaluation=UNSEEN) for comparison in tested)
    neighbors = [f"{a}-{b}" for rows in (TABLE_2, TABLE_4) for a, b in pairwise(_in_order(rows))]
    distant = [f"mpfa_per-{name}" for name in NAMES if name != "mpfa_per"]
    phis = "paper/phi/ddpg/mpfa_per"
    one = f"paper/ddpg/mpfa_per/{ONE_ROBOT.name}"
    return Table(
        "A",
        "The paper's own task: are its tables confirmed?",
        (
            *tested,
            Comparison(folder, ("mpfa_per",), PAPER, _seeds(3), arms=(ONE_ROBOT,)),
            phi,
            *unseen,
        ),
        _pairs("paper/ddpg", *neighbors),
        (
            *_pairs("paper/ddpg", *(d for d in distant if d not in neighbors), "per-uniform"),
            *_pairs("paper/plain", *_FIVE[:3], suffix=f"/{LETTER.name}"),
            *((f"{phis}/phi3", f"{phis}/phi{other}") for other in (2, 4)),
            (one, "paper/ddpg/mpfa_per"),
        ),
        {
            "the paper's Table 2": _arms("paper/ddpg", *TABLE_2, "uniform"),
            "the paper's Table 4": _arms("paper/ddpg", *TABLE_4),
            "to the letter": _arms("paper/plain", *first, suffix=f"/{LETTER.name}"),
            "one robot, sixteen": (one, "paper/ddpg/mpfa_per"),
        },
        primary="success",
        kinds=("test",),
    )


def _in_order(rows: Mapping[str, Tested]) -> list[str]:
    """Methods from the most successful to the least, of equal ones the faster one first."""
    return sorted(rows, key=lambda name: (-rows[name].success, rows[name].time))


def _table_b(root: Path) -> Table:
    learners = ("td3", "ddpg")
    return Table(
        "B",
        "Dense reward: does any priority help where every step is rewarded, and does any harm?",
        (Comparison(root / "dense", KEY, DENSE, _seeds(10), learners, evaluation=TEST),),
        tuple(pair for name in learners for pair in _pairs(f"dense/{name}", *_SIX)),
        tuple(pair for name in learners for pair in _pairs(f"dense/{name}", *_CONTROLS)),
        {name.upper(): _arms(f"dense/{name}", *KEY) for name in learners},
    )
