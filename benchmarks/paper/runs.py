"""Runs of which the paper's tables and figures are made, and the commands that make them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.paper.published import NAMES, PHIS
from torchrl_mpfa.methods.catalogue import PLUGIN
from training.comparison.arms import Arm
from training.comparison.jobs import Comparison, Job

SETTINGS = ("regime=paper", "robots=16", "updates=16", "learner.compile=true", "tracking=off")
"""The paper's task and replay volume, with sixteen robots in the place of one."""
PLUGIN_FILE = Path(__file__).parents[2] / PLUGIN
"""It registers the reconstructed methods."""
LETTER = Arm(
    "letter",
    ("environment.mirror=false", "environment.clearance=0.17", "exploration.varied=false"),
)
"""With ``learner=plain`` the paper to the letter: 0.35 m from the robot's center is a collision."""
ONE_ROBOT = Arm("one_robot", ("robots=1", "updates=1"))
CLAIMS = ("mpfa_per", "per", "uniform")
"""Methods of the arm to the letter."""
SEEDS = range(100, 110)
FEW = {"letter": range(100, 105), "one_robot": range(100, 103)}
"""Seeds of the arms that have fewer."""
BLOCKS = (SEEDS[:5], SEEDS[5:])
"""Seeds in the order in which they are made: five of all arms before the next five."""
NEW_SEEDS = range(110, 146)
"""Seeds that decide whether MPFA-PER fails less often than PER."""


def comparisons(folder: Path, seeds: Sequence[int] = SEEDS) -> list[Comparison]:
    """Return the comparisons of all tables and figures; an arm of few seeds has its own of them.

    Examples:
        >>> [len(each.jobs) for each in comparisons(Path("runs/paper"))]
        [130, 30, 15, 6]
    """
    phis = tuple(Arm(f"phi{phi}", (f"method.boost_factor={phi}",)) for phi in PHIS)

    def few(arm: Arm) -> tuple[int, ...]:
        return tuple(seed for seed in seeds if seed in FEW[arm.name])

    return [
        Comparison(folder, tuple(NAMES), (*SETTINGS, f"plugin={PLUGIN_FILE}"), seeds),
        Comparison(folder / "phi", ("mpfa_per",), (*SETTINGS, "curriculum=A"), seeds, arms=phis),
        Comparison(folder, CLAIMS, SETTINGS, few(LETTER), ("plain",), (LETTER,)),
        Comparison(folder, CLAIMS[:2], SETTINGS, few(ONE_ROBOT), arms=(ONE_ROBOT,)),
    ]


def question(folder: Path) -> Comparison:
    """Return the comparison that decides whether MPFA-PER fails less often than PER.

    Examples:
        >>> len(question(Path("runs/paper")).jobs)
        108
    """
    return Comparison(folder, CLAIMS, SETTINGS, NEW_SEEDS)


def without(comparison: Comparison, kept: set[str]) -> Iterator[Comparison]:
    """Yield the parts of a comparison, a seed each, whose runs are not among those kept."""
    for seed in comparison.seeds:
        one = replace(comparison, seeds=(seed,))
        by_method: dict[tuple[Arm, ...], list[str]] = {}
        for method in one.methods:
            # Each once, also of several learners.
            missing = tuple(
                dict.fromkeys(
                    job.arm for job in one.jobs if job.method == method and job.name not in kept
                )
            )
            by_method.setdefault(missing, []).append(method)
        for arms, methods in by_method.items():
            if arms:
                yield replace(one, methods=tuple(methods), arms=arms)


def finished(planned: Iterable[Comparison]) -> list[tuple[Comparison, Job]]:
    """Return the planned runs that are trained and evaluated."""
    return [
        (comparison, job)
        for comparison in planned
        for job in comparison.jobs
        if job.is_evaluated(comparison.evaluation)
    ]
