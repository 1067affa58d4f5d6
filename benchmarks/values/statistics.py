"""Differences of methods to one of them, paired by buffer and seed."""

from __future__ import annotations

import numpy as np
import pandas as pd

from training.statistics import mean_interval, sign_p

_UNITS = 3
"""From so many buffers on the unit is the buffer, below it the training."""
ERRORS = ("rmse", "returns_rmse")
"""Measures of which the ratio counts, in per cent."""
RANKS = ("rank", "returns_rank")
"""Measures of which the difference counts."""


def paired(rows: pd.DataFrame, column: str, *, against: str, at: int | None = None) -> pd.DataFrame:
    """Subtract a method from each, by the column of a measure, in :data:`ERRORS` its logarithm.

    A row is a buffer, the mean over its seeds, or with fewer than three buffers a training: of so
    many updates, or the mean over all marks. NaN where the other method has none.
    """
    chosen = rows if at is None else rows[rows["updates"] == at]
    index = ["buffer", "seed", "updates"]
    wide = chosen.pivot(index=index, columns="method", values=column)
    if column in ERRORS:
        wide = wide.apply(np.log)
    runs = wide.sub(wide[against], axis=0).groupby(level=["buffer", "seed"]).mean()
    few = runs.index.get_level_values("buffer").nunique() < _UNITS
    return runs if few else runs.groupby(level="buffer").mean()


def estimate(gaps: pd.Series, column: str) -> dict[str, float]:
    """Mean of differences, its 95 % interval and p, by Student's t and by permuted signs."""
    known = gaps.dropna().to_numpy()
    found = mean_interval(known)
    ends = np.array([found.value, found.low, found.high])
    mean, low, high = np.expm1(ends) if column in ERRORS else ends
    p = sign_p(known) if len(known) > 1 else np.nan
    return {column: mean, f"{column}_low": low, f"{column}_high": high, f"{column}_p": p}


def differences(rows: pd.DataFrame, *, against: str, at: int | None = None) -> pd.DataFrame:
    """Return the differences of all methods to one of them, the best first.

    Args:
        rows: Measures of trainings.
        against: The method that they are compared with.
        at: Updates; None: the mean over all marks.

    Returns:
        A row for each method by its name: ``rmse`` and ``returns_rmse``, changes as a share of the
        other's (-0.05 is five per cent less), ``rank`` and ``returns_rank``, differences of rank
        correlations, each with the ends of its 95 % interval and its p, and ``units``, the number
        of buffers or trainings of which they are; and ``effective`` and ``goals`` of its samples.
    """
    found: dict[str, dict[str, float]] = {}
    for column in (*ERRORS, *RANKS):
        for method, gaps in paired(rows, column, against=against, at=at).items():
            if method != against:
                of_method = found.setdefault(str(method), {"units": int(gaps.notna().sum())})
                of_method |= estimate(gaps, column)
    last = rows[rows["updates"] == rows["updates"].max()].groupby("method")
    sampled = last[["effective", "goals"]].mean()
    return pd.DataFrame.from_dict(found, "index").join(sampled).sort_values("rmse")
