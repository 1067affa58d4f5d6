"""Does MPFA-PER learn faster? Training of all runs of three methods, seed by seed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from benchmarks.paper.published import NAMES
from benchmarks.paper.rows import Rows
from benchmarks.paper.runs import CLAIMS
from training.comparison.report import p_text, table
from training.records import area_under
from training.statistics import holm, mean_interval, permuted_difference

LAST_WORLD = "D"
_LEVEL = 0.05
MEASURES = {
    "success in training": "{:.1%}",
    f"success in training, world {LAST_WORLD}": "{:.1%}",
    "area of success in validation": "{:.3f}",
    "reward per step": "{:.3f}",
    "steps of the training": "{:,.0f}",
}
"""Measures, and how their values are written."""
Trained = dict[str, pd.DataFrame]
"""Measures of the training of each run, by method."""


def trained(*tables: Rows) -> Trained:
    """Return the measures of all runs of the three methods, a row for each seed."""
    return {
        name: pd.DataFrame(
            {
                seed: _measured(episodes, rows.curves, f"ddpg-{name}", seed)
                for rows in tables
                for seed, episodes in rows.episodes(f"ddpg-{name}").items()
            }
        ).T
        for name in CLAIMS
    }


def _measured(
    episodes: pd.DataFrame, curves: pd.DataFrame, arm: str, seed: int
) -> Mapping[str, float]:
    """Measure the training of a run."""
    curve = curves[(curves["arm"] == arm) & (curves["seed"] == seed)]
    values = (
        episodes["success"].mean(),
        episodes.loc[episodes["world"] == LAST_WORLD, "success"].mean(),
        area_under(curve["total_steps"], curve["success"]),
        episodes["reward"].sum() / episodes["steps"].sum(),
        episodes["total_steps"].iloc[-1],
    )
    return dict(zip(MEASURES, map(float, values), strict=True))


def compare(found: Trained) -> dict[tuple[str, str], tuple[float, float]]:
    """Return p of MPFA-PER beside the others, by measure: as it is, and corrected for all."""
    ours, *others = CLAIMS
    pairs = [(measure, other) for measure in MEASURES for other in others]
    ps = []
    for measure, other in pairs:
        sides = [
            {str(seed): run for seed, run in found[name][measure].items()} for name in (ours, other)
        ]
        ps.append(permuted_difference(*sides).p)
    return dict(zip(pairs, zip(ps, holm(np.array(ps)), strict=True), strict=True))


def said(found: Trained) -> str:
    """Say whether MPFA-PER trains faster than PER and than uniform replay."""
    corrected = {pair: p for pair, (_, p) in compare(found).items()}
    seeds = len(found[CLAIMS[0]])
    parts = []
    for other in CLAIMS[1:]:
        differ = [measure for measure in MEASURES if corrected[measure, other] < _LEVEL]
        verb = "differs" if differ else "shows no difference"
        where = f" in {' and '.join(differ)}" if differ else ""
        parts.append(f"{verb} from {NAMES[other]}{where}")
    return f"In the training of {seeds} seeds MPFA-PER {' and '.join(parts)} (exploratory)."


def convergence_table(found: Trained) -> str:
    """Return means with intervals, and p of MPFA-PER beside the others."""
    ps, others = compare(found), CLAIMS[1:]
    lines = []
    for measure, form in MEASURES.items():
        cells = [measure]
        for name in CLAIMS:
            mean = mean_interval(found[name][measure].to_numpy(dtype=float))
            ends = ", ".join(form.format(end) for end in (mean.low, mean.high))
            cells.append(f"{form.format(mean.value)} [{ends}]")
        cells += [", ".join(map(p_text, ps[measure, other])) for other in others]
        lines.append(cells)
    beside = [f"p beside {NAMES[name]}, corrected" for name in others]
    return table(["", *(f"{NAMES[name]}, 95 %" for name in CLAIMS), *beside], lines)
