"""Make the paper's figures and tables from the runs there are, and name the others.

    python -m benchmarks.study paper runs/paper

It writes ``paper.md`` with Tables 2 to 4 next to the paper's numbers, ``figure_3.png``,
``figure_5.png``, ``figure_8.png`` to ``figure_11.png``, ``figure_13.png``, and ``claims.png`` on
what Section 2.4 says about PER. Missing runs are named, with the command that makes them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.study.paper import RUNS, comparisons, evaluation_of, missing_lines, read_runs
from benchmarks.study.paper_figures import plot_paper
from benchmarks.study.paper_tables import paper_tables
from torchrl_mpfa.saving import write_text_atomically
from training import files
from training.comparison.jobs import Comparison


def write_paper(wanted: Sequence[Comparison], output: Path) -> int:
    """Make the paper's tables and figures of the runs that there are, and name the others.

    Args:
        wanted: The comparison of all methods, and that of Fig. 5.
        output: Where they go.

    Returns:
        Exit status: 1 if there are no runs at all.
    """
    trained, updates, tested = (
        read_runs(wanted, find)
        for find in (
            lambda job: job.path / files.EPISODES,
            lambda job: job.path / files.UPDATES,
            evaluation_of,
        )
    )
    absent = missing_lines(wanted)
    text = paper_tables(trained, tested)
    if absent:
        text += f"\n\n## Missing\n\n{absent}"
    print(text)
    if not trained:
        return 1
    output.mkdir(parents=True, exist_ok=True)
    write_text_atomically(text + "\n", output / "paper.md")
    for path in plot_paper(trained, updates, output):
        print(f"written: {path}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the rows, write tables and figures."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.study paper",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="of the runs")
    parser.add_argument("--output", type=Path, help="folder (default: that of the runs)")
    parser.add_argument(
        "--seeds", type=int, default=RUNS, help=f"runs of each method (default: {RUNS})"
    )
    options = parser.parse_args(arguments)
    output = options.output or options.folder
    if options.seeds < 1:
        parser.error(f"--seeds must be at least 1, got {options.seeds}")
    try:
        files.check_folder(output)
        return write_paper(comparisons(options.folder, seeds=options.seeds), output)
    except ValueError as error:
        parser.error(" ".join(str(error).split()))
