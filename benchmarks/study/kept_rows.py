"""Rows of the study that are kept as compressed files, so that they outlive the runs' folders."""

from __future__ import annotations

import gzip
import os
from io import StringIO
from pathlib import Path

import pandas as pd

from benchmarks.study.rows import CURVES, TESTS, Rows, together

_RUN = ["arm", "seed"]
_FILES = ("-curves.csv.gz", "-tests.csv.gz")


def keep(rows: Rows, folder: Path, name: str) -> list[Path]:
    """Write the rows of a table as two compressed files, the same bytes for the same rows.

    Runs that are kept there already stay, unless ``rows`` has them anew.
    """
    folder.mkdir(parents=True, exist_ok=True)
    whole = joined(rows, read_kept(folder, name))
    flags = whole.tests.astype({"success": int, "collision": int})
    paths = [folder / f"{name}{end}" for end in _FILES]
    for path, found in zip(paths, (whole.curves, flags), strict=True):
        # Rows of a run are in their order; of the runs it must not depend on who came when.
        text = found.sort_values(_RUN, kind="stable").to_csv(index=False, lineterminator="\n")
        # Neither a date nor a name is in it, so that the same rows are the same bytes.
        half_written = path.with_suffix(".part")
        half_written.write_bytes(gzip.compress(text.encode(), mtime=0))
        os.replace(half_written, path)
    return paths


def read_kept(folder: Path, name: str) -> Rows:
    """The rows that :func:`keep` wrote; none if it did not."""
    found = []
    for end, columns in zip(_FILES, (CURVES, TESTS), strict=True):
        path = folder / f"{name}{end}"
        if not path.exists():
            found.append(together([], columns))
            continue
        text = gzip.decompress(path.read_bytes()).decode()
        found.append(pd.read_csv(StringIO(text), keep_default_na=False, na_values=[""]))
    curves, tests = found
    return Rows(curves, tests.astype({"success": bool, "collision": bool}))


def read_all_kept(folder: Path) -> Rows:
    """The rows that are kept of all tables; a run that several of them have is there once."""
    rows = Rows(together([], CURVES))
    for path in sorted(folder.glob(f"*{_FILES[0]}")):
        rows = joined(rows, read_kept(folder, path.name.removesuffix(_FILES[0])))
    return rows


def is_kept(folder: Path) -> bool:
    """Whether a folder holds kept rows, and not runs."""
    return any(folder.glob(f"*{_FILES[0]}"))


def joined(rows: Rows, others: Rows) -> Rows:
    """Rows, and of others the runs that are not among them.

    A run that was trained anew and is not tested yet gives way to that of the others which is.
    """
    untested = _runs(rows.curves).difference(_runs(rows.tests))
    first = _without(rows, untested.intersection(_runs(others.tests)))
    rest = _without(others, _runs(first.curves))
    return Rows(
        together([first.curves, rest.curves], others.curves.columns.tolist()),
        together([first.tests, rest.tests], others.tests.columns.tolist()),
    )


def of_arms(rows: Rows, labels: set[str]) -> Rows:
    """The rows of some arms."""
    return Rows(
        rows.curves[rows.curves["arm"].isin(labels)], rows.tests[rows.tests["arm"].isin(labels)]
    )


def _runs(table: pd.DataFrame) -> pd.MultiIndex:
    return pd.MultiIndex.from_frame(table[_RUN])


def _without(rows: Rows, runs: pd.MultiIndex) -> Rows:
    return Rows(
        rows.curves[~_runs(rows.curves).isin(runs)], rows.tests[~_runs(rows.tests).isin(runs)]
    )
