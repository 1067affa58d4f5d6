"""Records of a run: a row for each training episode and each evaluation."""

from __future__ import annotations

from collections.abc import Sequence
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


def read_table(path: Path) -> pd.DataFrame:
    """Read a table; one without rows if there is no such file."""
    import pandas as pd

    if not path.exists():
        return pd.DataFrame()
    # An arm may be called 3 or None: only an empty cell has no value.
    try:
        return pd.read_csv(path, dtype={"arm": str}, keep_default_na=False, na_values=[""])
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is damaged, its rows cannot be read: remove it") from error
