"""Pages and pictures of the study, of its runs or of the rows that are kept of them."""

from __future__ import annotations

from pathlib import Path

from navigation.report.study_figures import plot_study
from navigation.report.study_rows import is_kept, missing, read_kept, read_runs
from navigation.report.study_tables import study_tables
from navigation.studies.protocol import ROOT, tables
from torchrl_mpfa.saving import write_text_atomically


def write_study(folder: Path, output: Path) -> list[Path]:
    """Write a page and the figures of each table that has rows, and name the runs it lacks.

    Args:
        folder: Of the study, or of what ``study.py --keep`` made of it.
        output: Where they go.

    Returns:
        The files; none if there are no rows.
    """
    kept = is_kept(folder)
    # What is kept does not say where the runs were.
    root = ROOT if kept else folder
    made = []
    for name, table in tables(root).items():
        rows = read_kept(folder, name) if kept else read_runs(table, root)
        if not len(rows.curves):
            continue
        output.mkdir(parents=True, exist_ok=True)
        text = study_tables(table, rows, absent=missing(table, rows, root))
        write_text_atomically(text + "\n", output / f"{name}.md")
        made += [output / f"{name}.md", *plot_study(table, rows, output)]
    return made
