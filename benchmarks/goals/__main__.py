"""Make runs on goal tasks of gymnasium-robotics, and keep their rows.

    python -m benchmarks.goals search             choose the settings, by HER on seeds of its own
    python -m benchmarks.goals                    make the runs, write docs/results/goals.csv, and
                                                  what was sampled into goals_replay.csv beside it
    python -m benchmarks.goals --kept             print the tables of the kept rows
    python -m benchmarks.goals exploratory        the same of arms that show why, with rows in
                                                  goals_exploratory.csv
    python -m benchmarks.goals --tasks FetchReach-v4 --arms HER uniform --seeds 100 101

Runs are those of ``examples/gymnasium_td3.py``, and for *SB3's HER* of Stable-Baselines3's TD3 with
its own buffer. A run has its rows in the file as soon as it has ended, and is not made again: the
same command continues. It needs the extras ``robotics`` and ``peers``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.goals.arms import ARMS, EVERY, EXPLORATORY, PLANNED, SB3, SB3_SEEDS, SEEDS, STEPS
from benchmarks.goals.runs import make, search
from benchmarks.goals.tables import (
    EXPLORED,
    KEPT,
    SEARCHED,
    explored_table,
    peer_table,
    tables,
    unplanned_table,
)
from training.files import run_script


def main(arguments: Sequence[str] | None = None) -> int:
    """Search, make the missing runs, or print the tables; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.goals",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "what", nargs="?", choices=["runs", "search", "exploratory"], default="runs"
    )
    parser.add_argument("--tasks", nargs="+", choices=list(STEPS), default=list(PLANNED))
    parser.add_argument("--arms", nargs="+", choices=list(EVERY), help="in place of all")
    parser.add_argument("--seeds", nargs="+", type=int, help="in place of those of the design")
    parser.add_argument("--folder", type=Path, default=Path("runs/goals"), help="of the runs")
    parser.add_argument("--output", type=Path, help="of the rows")
    parser.add_argument("--kept", action="store_true", help="print tables of kept rows alone")
    options = parser.parse_args(arguments)
    if options.what == "search":
        print(search(options.tasks, options.folder / "search", options.output or SEARCHED))
        return 0
    exploratory = options.what == "exploratory"
    kept = options.output or (EXPLORED if exploratory else KEPT)
    if not options.kept:
        usual = EXPLORATORY if exploratory else [*ARMS, SB3]
        seeds = {SB3: SB3_SEEDS} if options.seeds is None else {}
        arms = {arm: seeds.get(arm, options.seeds or SEEDS) for arm in options.arms or usual}
        make(options.tasks, arms, options.folder, kept)
    parts = [explored_table(kept)] if exploratory else [tables(kept)]
    if kept == KEPT:
        parts += [unplanned_table(), peer_table(), explored_table()]
    print("\n\n".join(parts))
    return 0


if __name__ == "__main__":
    run_script(main)
