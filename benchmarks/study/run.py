"""Train and evaluate the runs of the study, table by table; it continues where it was stopped.

    python -m benchmarks.study run --list          each table: its question, runs, commands
    python -m benchmarks.study run                 all of them
    python -m benchmarks.study run C D --jobs 4    two tables, four runs at a time
    python -m benchmarks.study run --seeds 3       three runs of each arm first
    python -m benchmarks.study run --keep docs/results/study    add the rows of finished runs to it
    python -m benchmarks.study run --kept docs/results/study    make only runs that it lacks

Every run is made as by ``compare.py`` with the commands that ``--list`` shows. What is trained and
evaluated is left alone; Ctrl-C saves what is in progress, and the same command continues it. Tables
A to D are in ``benchmarks/study/protocol.py``, with one folder per task in ``--folder``; table F,
which is not about navigation, is made by ``python -m benchmarks.study gym``. The checkpoint of a
finished run is removed: thousands of them take tens of gigabytes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.study.designs import tables
from benchmarks.study.kept_rows import is_kept, joined, keep, of_arms, read_all_kept
from benchmarks.study.protocol import ROOT, Table, label_of
from benchmarks.study.remaining import counts, free_checkpoints, hours_left, parts_left
from benchmarks.study.rows import Rows, read_runs, without_rows
from training import files
from training.comparison.execution import make_runs
from training.comparison.jobs import Comparison
from training.settings.train import register


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.study run",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    names = list(tables(ROOT))
    parser.add_argument(
        "tables", nargs="*", metavar="TABLE", help=f"of {', '.join(names)} (default: all)"
    )
    parser.add_argument("--folder", type=Path, default=ROOT, help=f"(default: {ROOT})")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time (default: 2)")
    parser.add_argument("--seeds", type=int, help="runs of each arm at most (default: all)")
    parser.add_argument("--list", action="store_true", help="list what there is; run nothing")
    rows = parser.add_mutually_exclusive_group()
    rows.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="add the rows to those there; run nothing"
    )
    rows.add_argument(
        "--kept", type=Path, metavar="FOLDER", help="runs whose rows are there are not made again"
    )
    options = parser.parse_args(arguments)
    for name in options.tables:
        if name not in names:
            parser.error(f"there is no table {name}; there are: {', '.join(names)}")
    for option in ("jobs", "seeds"):
        value = getattr(options, option)
        if value is not None and value < 1:
            parser.error(f"--{option} must be at least 1, got {value}")
    for folder in (options.folder, options.keep or options.folder):
        try:
            files.check_folder(folder)
        except ValueError as error:
            parser.error(str(error))
    if options.kept and not is_kept(options.kept):
        parser.error(f"--kept {options.kept}: no rows of the study are there, which --keep writes")
    found = tables(options.folder, most=options.seeds)
    options.tables = [found[name] for name in options.tables or names]
    if options.kept:
        there = read_all_kept(options.kept)
        options.tables = [left_of(table, there, options.folder) for table in options.tables]
    return options


def left_of(table: Table, rows: Rows, root: Path) -> Table:
    """A table with the runs alone that are not among the rows."""
    parts = (
        part
        for comparison in table.comparisons
        for part in parts_left(comparison, without_rows(comparison, rows, root))
    )
    return replace(table, comparisons=tuple(parts))


def summary(chosen: Sequence[Table], *, jobs: int) -> str:
    """How much of some tables is done, and what is left of it."""
    comparisons = [comparison for table in chosen for comparison in table.comparisons]
    done, wanted = counts(comparisons)
    text = f"{', '.join(table.name for table in chosen)}: {done} of {wanted} runs"
    hours = hours_left(comparisons, jobs=jobs) if done < wanted else 0.0
    return text if not hours else f"{text}, about {hours:.1f} h left with {jobs} at a time"


def listing(chosen: Sequence[Table]) -> str:
    """The questions, runs and commands of some tables."""
    lines = []
    for table in chosen:
        done, wanted = counts(table.comparisons)
        lines.append(f"{table.name}  {table.question}  {done} of {wanted} runs")
        for comparison in table.comparisons:
            done, wanted = counts([comparison])
            lines += ["", f"    # {done} of {wanted}", f"    {comparison.command}"]
        lines.append("")
    return "\n".join(lines)


def kept(chosen: Sequence[Table], root: Path, folder: Path) -> str:
    """Keep the rows of some tables, and say what was written."""
    lines, others = [], read_all_kept(folder)
    for table in chosen:
        rows = read_runs(table, root)
        if len(rows.curves):
            # Runs that it shares with another table may be kept there alone.
            labels = {
                label_of(job, root) for comparison in table.comparisons for job in comparison.jobs
            }
            rows = joined(rows, of_arms(others, labels))
        for path in keep(rows, folder, table.name) if len(rows.curves) else []:
            lines.append(f"written: {path}, {path.stat().st_size / 1e6:.2f} MB")
    return "\n".join(lines) or f"no run is at its end in {root}: nothing is written"


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the runs that are missing.

    Args:
        arguments: The command line.

    Returns:
        Exit status: 0, the highest of :func:`make_runs`, or 128 and the number of the signal that
        stopped it; 2 for a table whose runs cannot be made.
    """
    options = parse(arguments)
    if options.list or options.keep:
        if options.list:
            print(listing(options.tables))
        if options.keep:
            print(kept(options.tables, options.folder, options.keep))
        return 0
    register()
    worst = 0
    for table in options.tables:
        for comparison in table.comparisons:
            done, wanted = counts([comparison])
            if done < wanted:
                print(
                    f"{summary(options.tables, jobs=options.jobs)}\n"
                    f"{table.name}: {comparison.command}"
                )
                worst = max(worst, _make(comparison, options.jobs))
            free_checkpoints(comparison)
            if worst >= 128:
                return worst
    print(summary(options.tables, jobs=options.jobs))
    return worst


def _make(comparison: Comparison, jobs: int) -> int:
    """Make the runs of a comparison; 2 if they cannot be, as of ``compare.py``."""
    try:
        return make_runs(comparison, most=jobs)
    except (ValueError, files.FolderInUse) as error:
        print(f"run: {error}", file=sys.stderr)
        return 2
