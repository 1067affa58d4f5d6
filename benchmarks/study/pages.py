"""Pages and pictures of the study, of its runs or of the rows that are kept of them."""

from __future__ import annotations

from pathlib import Path

from benchmarks.study.designs import tables
from benchmarks.study.figures import plot_study
from benchmarks.study.gym import table as off_navigation
from benchmarks.study.gym.table import FOLDER, TABLE_F
from benchmarks.study.kept_rows import is_kept, read_kept
from benchmarks.study.protocol import ROOT, Table
from benchmarks.study.rows import Rows, missing, read_runs
from benchmarks.study.tables import study_tables
from torchrl_mpfa.saving import write_text_atomically

_TITLES = {
    "curves": "Mean of the runs and its 95 % interval; gray: what an arm is compared with",
    "profiles": "Share of runs above each value of the primary measure; bands: three arms",
    "arms": "The primary measure of each run, with mean and 95 % interval of each arm",
    "volumes": "Area by replay volume and method; gray: not run, or too few to compare",
}


def write_study(folder: Path, output: Path) -> list[Path]:
    """Write a page and the figures of each table that has rows, and name the runs it lacks."""
    kept = is_kept(folder)
    # What is kept does not say where the runs were.
    root = ROOT if kept else folder
    made = []
    for name, table in tables(root).items():
        rows = read_kept(folder, name) if kept else read_runs(table, root)
        if len(rows.curves):
            made += _write(table, rows, output, absent=missing(table, rows, root))
    rows = read_kept(folder, TABLE_F.name) if kept else off_navigation.read_runs(folder / FOLDER)
    if len(rows.curves):
        absent = off_navigation.missing(rows, root / FOLDER)
        made += _write(TABLE_F, off_navigation.with_mean(rows), output, absent=absent)
    return made


def _write(table: Table, rows: Rows, output: Path, *, absent: str) -> list[Path]:
    output.mkdir(parents=True, exist_ok=True)
    page, figures = output / f"{table.name}.md", plot_study(table, rows, output)
    shown = "\n\n".join(f"![{_TITLES[path.stem[2:]]}]({path.name})" for path in figures)
    text = study_tables(table, rows, absent=absent)
    write_text_atomically(f"{text}\n\n## Figures\n\n{shown}\n", page)
    return [page, *figures]
