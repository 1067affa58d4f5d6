"""Tables A to D, and all tables of the study together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from benchmarks.study.experiments import experiments
from benchmarks.study.paper import NAMES, TABLE_2, TABLE_4, Tested, comparisons
from benchmarks.study.protocol import (
    DENSE,
    SPARSE,
    TEST,
    VOLUMES,
    Table,
    arms_of,
    pairs_of,
    seeds_of,
)
from torchrl_mpfa.methods import METHODS
from torchrl_mpfa.methods.catalogue import ALIASES
from training.comparison.arms import PLAIN, Arm
from training.comparison.jobs import TESTED, Comparison, Evaluation

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
    name for name in METHODS if name not in ALIASES.values() and name not in ("her", "uper")
)
"""Methods of the catalogue by the name that fits all learners, but those that came after table C
was designed: they have experiments of their own."""

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
        [4, 6, 8, 1, 2, 1, 2, 4, 2]
    """
    if most is not None and most < 1:
        raise ValueError(f"most must be at least 1, got {most}")
    made = (_table_c(root), _table_d(root), _table_a(root), _table_b(root), *experiments(root))
    return {table.name: _at_most(table, most) for table in made}


def _at_most(table: Table, most: int | None) -> Table:
    return replace(
        table,
        comparisons=tuple(replace(each, seeds=each.seeds[:most]) for each in table.comparisons),
    )


_FIVE = (
    "per-uniform",
    "mpfa_per-uniform",
    "mpfa_per-per",
    "mpfa_plus-per",
    "mpfa_plus-mpfa_per",
)
_SIX = (*_FIVE, "mpf_per-per")
_CONTROLS = ("mpfa_plus-uniform", "lap-uniform", "la3p-uniform_halves")


def _table_c(root: Path) -> Table:
    folder, seeds = root / "sparse", seeds_of(20)
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
            Comparison(folder, few, SPARSE, seeds_of(10), ("td3",), evaluation=TEST),
            Comparison(folder, KEY, SPARSE, seeds_of(10), ("ddpg",), evaluation=TEST),
            Comparison(folder, ("lap",), SPARSE, seeds, ("td3",), (MEDIAN,), TEST),
        ),
        pairs_of("sparse/td3", *_SIX),
        (
            *pairs_of("sparse/td3", *others, "la3p-uniform_halves"),
            *(
                ("sparse/td3/lap/median", f"sparse/td3/{other}")
                for other in ("lap", "per", "uniform")
            ),
            *pairs_of("sparse/ddpg", *_SIX, *_CONTROLS),
        ),
        {
            "TD3": arms_of("sparse/td3", *KEY, "lap/median"),
            "DDPG": arms_of("sparse/ddpg", *KEY),
            "TD3, more of the paper's": arms_of(
                "sparse/td3", "uniform", "per", *(n for n in rest if n in NAMES)
            ),
            "TD3, others": arms_of(
                "sparse/td3", "uniform", "per", *(n for n in rest if n not in NAMES)
            ),
        },
    )


def _table_d(root: Path) -> Table:
    folder, at = root / "sparse", "sparse/td3"

    def of(volume: int, methods: Sequence[str], seeds: int) -> Comparison:
        arms = (PLAIN,) if volume == 32 else (Arm(f"v{volume}", VOLUMES[volume]),)
        return Comparison(folder, tuple(methods), SPARSE, seeds_of(seeds), ("td3",), arms, TEST)

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
            *pairs_of(at, *_FIVE[:3], suffix=ends[8]),
            *(pair for volume in (128, 256) for pair in pairs_of(at, *_FIVE, suffix=ends[volume])),
        ),
        (
            *pairs_of(
                at, "mpfa_plus-uniform", "lap-uniform", "geometric-uniform", suffix=ends[128]
            ),
            *pairs_of(at, "mpfa_plus-uniform", suffix=ends[256]),
        ),
        {
            f"sparse, volume {volume}": arms_of(at, *methods, suffix=ends[volume])
            for volume, methods in OF_VOLUMES.items()
        },
    )


def _table_a(root: Path) -> Table:
    folder = root / "paper"
    first = ("mpfa_per", "per", "uniform")
    _, phi = comparisons(folder, seeds=10)
    phi = replace(phi, settings=(*PAPER, *phi.settings[1:]), seeds=seeds_of(10))
    tested = (
        Comparison(folder, first, PAPER, seeds_of(10)),
        Comparison(folder, tuple(n for n in NAMES if n not in first), PAPER, seeds_of(10)),
        Comparison(folder, first, PAPER, seeds_of(10), ("plain",), (LETTER,)),
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
            Comparison(folder, ("mpfa_per",), PAPER, seeds_of(3), arms=(ONE_ROBOT,)),
            phi,
            *unseen,
        ),
        pairs_of("paper/ddpg", *neighbors),
        (
            *pairs_of("paper/ddpg", *(d for d in distant if d not in neighbors), "per-uniform"),
            *pairs_of("paper/plain", *_FIVE[:3], suffix=f"/{LETTER.name}"),
            *((f"{phis}/phi3", f"{phis}/phi{other}") for other in (2, 4)),
            (one, "paper/ddpg/mpfa_per"),
        ),
        {
            "the paper's Table 2": arms_of("paper/ddpg", *TABLE_2, "uniform"),
            "the paper's Table 4": arms_of("paper/ddpg", *TABLE_4),
            "to the letter": arms_of("paper/plain", *first, suffix=f"/{LETTER.name}"),
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
        (Comparison(root / "dense", KEY, DENSE, seeds_of(10), learners, evaluation=TEST),),
        tuple(pair for name in learners for pair in pairs_of(f"dense/{name}", *_SIX)),
        tuple(pair for name in learners for pair in pairs_of(f"dense/{name}", *_CONTROLS)),
        {name.upper(): arms_of(f"dense/{name}", *KEY) for name in learners},
    )
