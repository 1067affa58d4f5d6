"""Records of a run: a row for each training episode and each evaluation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_mpfa.saving import write_text_atomically

# Imported where a table is made: it takes half a second, which a run's start need not wait.
if TYPE_CHECKING:
    import pandas as pd


@dataclass
class EpisodeRecord:
    """One training episode."""

    episode: int
    world: str
    """World of the stage; for a generator, its name."""
    steps: int
    """Actions of this episode."""
    total_steps: int
    """Actions of all robots when it ended."""
    reward: float
    """Total reward."""
    average_reward: float
    """Total reward over steps, the paper's curve."""
    seconds: float
    """Wall-clock time of the run when it ended [s]."""
    success: bool
    collision: bool
    timeout: bool
    path_length: float
    """Distance driven [m]."""
    shortest_path: float
    """Shortest path of the task [m]."""


@dataclass
class EvaluationRecord:
    """One evaluation during training."""

    total_steps: int
    episode: int
    """Training episodes finished."""
    world: str
    """World of the evaluation."""
    success: float
    collision: float
    timeout: float
    spl: float
    sct: float
    """Mean success weighted by completion time, see :func:`mpfa_envs.evaluation.results.sct`."""
    seconds: float
    """Wall-clock time that it took [s]."""
    trained_for: float
    """Wall-clock time of the run before it, less that of evaluations [s]."""

    def is_best(self, others: Sequence[EvaluationRecord]) -> bool:
        """Return True if no other has a higher success, or the same success and a higher SCT."""
        mine = (self.success, self.sct)
        return all(mine >= (other.success, other.sct) for other in others)


def last_best(records: Sequence[EvaluationRecord]) -> EvaluationRecord:
    """The best evaluation, of equal ones the last."""
    return next(record for record in reversed(records) if record.is_best(records))


def as_table(rows: Sequence[Any], kind: type[Any]) -> pd.DataFrame:
    """Rows of one kind as a table."""
    import pandas as pd

    columns = [entry.name for entry in fields(kind)]
    return pd.DataFrame([asdict(row) for row in rows], columns=columns)


def area_under(steps: pd.Series[Any], values: pd.Series[Any]) -> float:
    """Mean height of a curve that starts at zero, over its steps."""
    x, y = np.concatenate(([0.0], steps)), np.concatenate(([0.0], values))
    return float(np.trapezoid(y, x) / x[-1])


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write a table as CSV, in one step."""
    write_text_atomically(table.to_csv(index=False), path)


def checked_words(rows: pd.DataFrame, names: Sequence[str], path: Path) -> None:
    """Raise for an empty cell in columns that name something, by its line."""
    for name in names:
        empty = rows[name].isna() | (rows[name].astype(str).str.strip() == "")
        if empty.any():
            line = rows.index[empty.to_numpy()][0] + 2
            raise ValueError(f"{path}:{line}: {name} must not be empty")


def checked_numbers(rows: pd.DataFrame, name: str, path: Path) -> pd.Series[Any]:
    """Return a column as numbers, True as 1; raise for what is none, or not finite, by its line."""
    import pandas as pd

    flags = {"true": 1.0, "false": 0.0}
    words = rows[name].map(lambda cell: flags.get(str(cell).strip().lower(), cell))
    values = pd.to_numeric(words, errors="coerce").astype(float)
    wrong = ~np.isfinite(values.to_numpy())
    if wrong.any():
        cell = rows[name].to_numpy()[wrong][0]
        got = "an empty cell" if pd.isna(cell) or not str(cell).strip() else repr(str(cell))
        line = rows.index[wrong][0] + 2
        raise ValueError(f"{path}:{line}: {name} must be a finite number, got {got}")
    return values


def read_table(path: Path) -> pd.DataFrame:
    """Read a table; one without rows if there is no such file."""
    import pandas as pd

    if not path.exists():
        return pd.DataFrame()
    # An arm may be called 3 or None: only an empty cell has no value.
    with _readable(path):
        return pd.read_csv(path, dtype={"arm": str}, keep_default_na=False, na_values=[""])


def read_words(path: Path) -> pd.DataFrame:
    """Read a table of any script as text; the row of line N has the index N - 2."""
    import pandas as pd

    with _readable(path):
        head = path.read_text(encoding="utf-8-sig").partition("\n")[0]
        separator = max(",;\t", key=head.count)
        rows = pd.read_csv(
            path,
            sep=separator,
            dtype=str,
            encoding="utf-8-sig",
            keep_default_na=False,
            na_values=[""],
            skip_blank_lines=False,
            skipinitialspace=True,
            index_col=False,
        )
    return rows.rename(columns=str.strip).dropna(how="all")


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Name the file in errors about what is no table."""
    import pandas as pd

    try:
        yield
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        why = " ".join(str(error).split())
        raise ValueError(f"{path} is damaged, its rows cannot be read: {why}") from error
