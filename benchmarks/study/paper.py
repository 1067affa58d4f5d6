"""The paper's experiments: their figures and tables, the runs that they need, and its numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from training import files
from training.comparison.arms import Arm
from training.comparison.jobs import TESTED, Comparison, Job
from training.figures import Runs
from training.records import read_table

RUNS = 10
"""Experiments that each curve of the paper is the mean of."""
PHI = "phi"
"""Folder of the comparison of Fig. 5, in that of the others."""


class Tested(NamedTuple):
    """A row of Tables 2 and 4: 200 episodes in the unseen world."""

    collisions: int
    success: float
    time: float
    """Mean time of an episode [s]."""


class Trained(NamedTuple):
    """A row of Table 3: 1,000 episodes in the worlds A to D."""

    minutes: int
    steps: int


NAMES = {
    "per": "PER",
    "td_reward": "TD-error + reward",
    "td_loss": "TD-error + loss",
    "mpf_per": "MPF-PER",
    "raise": "Raise priority",
    "decay": "Decay priority",
    "mpfa_per": "MPFA-PER",
    "klper": "KLPER",
    "ddpg_radam": "DDPG + RAdam",
    "hvper": "HVPER",
    "averaged_ddpg": "Averaged-DDPG",
    "mw": "MW-MADDPG",
    "uniform": "uniform",
}
"""What the paper calls the methods; uniform replay is in none of its tables."""
TABLE_2 = {
    "per": Tested(29, 0.855, 31.8),
    "td_reward": Tested(24, 0.880, 30.1),
    "td_loss": Tested(25, 0.875, 30.5),
    "mpf_per": Tested(21, 0.895, 28.2),
    "raise": Tested(22, 0.890, 30.3),
    "decay": Tested(23, 0.885, 29.8),
    "mpfa_per": Tested(19, 0.905, 27.3),
}
TABLE_3 = {
    "klper": Trained(1284, 219_318),
    "ddpg_radam": Trained(1589, 224_048),
    "hvper": Trained(2082, 247_043),
    "averaged_ddpg": Trained(1522, 222_569),
    "mw": Trained(1675, 233_047),
    "mpfa_per": Trained(994, 213_627),
}
TABLE_4 = {
    "klper": Tested(24, 0.880, 29.4),
    "ddpg_radam": Tested(25, 0.875, 31.5),
    "hvper": Tested(27, 0.865, 34.2),
    "averaged_ddpg": Tested(28, 0.860, 30.9),
    "mw": Tested(27, 0.865, 32.8),
    "mpfa_per": Tested(19, 0.905, 27.3),
}
TESTS = 200
"""Episodes of Tables 2 and 4."""
CURVES = {
    8: ("per", "td_reward", "td_loss", "mpf_per"),
    9: ("per", "raise"),
    10: ("per", "raise", "decay"),
    11: ("per", "raise", "decay", "mpf_per", "mpfa_per"),
}
"""Methods of the figures of reward by map; of Fig. 10 and 11 as far as the text names them."""
PHIS = (2, 3, 4)
CLAIMS = ("uniform", "per", "mpfa_per")
"""Those by which Section 2.4's claims on PER are looked at."""


def comparisons(folder: Path, *, seeds: int = RUNS) -> tuple[Comparison, Comparison]:
    """The comparison of all figures and tables but Fig. 5, and that of Fig. 5.

    Args:
        folder: Where the first is; the second is in a folder in it.
        seeds: Runs of each method.

    Returns:
        Both.

    Examples:
        >>> comparisons(Path("runs/paper"), seeds=1)[1].command
        'python examples/compare.py --folder runs/paper/phi --arm=phi2:method.boost_factor=2 \
--arm=phi3:method.boost_factor=3 --arm=phi4:method.boost_factor=4 --methods mpfa_per --seeds 0 \
-- regime=paper curriculum=A'
    """
    of_all = range(seeds)
    arms = tuple(Arm(f"phi{phi}", (f"method.boost_factor={phi}",)) for phi in PHIS)
    return (
        Comparison(folder, tuple(NAMES), ("regime=paper",), of_all),
        Comparison(
            folder / PHI, ("mpfa_per",), ("regime=paper", "curriculum=A"), of_all, arms=arms
        ),
    )


def missing(comparison: Comparison) -> list[str]:
    """Runs that are not at their end, have no rows, or were not tested; by name."""
    return [job.name for jobs in comparison.runs().values() for job in jobs if not _is_whole(job)]


def missing_lines(wanted: Sequence[Comparison]) -> str:
    """Which runs are missing, and the commands that make them."""
    lines = []
    for comparison in wanted:
        found = missing(comparison)
        if found:
            runs = "1 run is" if len(found) == 1 else f"{len(found)} runs are"
            lines.append(f"{runs} missing in {comparison.folder}: {', '.join(found)}.")
            lines.append(f"\n    {comparison.command}\n")
    return "\n".join(lines).rstrip()


def read_runs(wanted: Sequence[Comparison], find: Callable[[Job], Path | None]) -> Runs:
    """A table of each run that is at its end and has it, by method or arm."""
    found: dict[str, dict[str, pd.DataFrame]] = {}
    for comparison in wanted:
        for name, jobs in comparison.runs().items():
            for job in jobs:
                file = find(job) if job.is_trained() else None
                rows = pd.DataFrame() if file is None else read_table(file)
                if len(rows):
                    found.setdefault(name, {})[job.name] = rows
    return found


def evaluation_of(job: Job) -> Path | None:
    """The rows of a run in the unseen world, if its policy was tested there as those of all are."""
    return job.results(TESTED) / files.EPISODES if job.is_evaluated(TESTED) else None


def _is_whole(job: Job) -> bool:
    rows = read_table(job.path / files.UPDATES)
    return job.is_trained() and evaluation_of(job) is not None and len(rows) > 0
