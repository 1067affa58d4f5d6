"""Differences that a design planned, with the p that the design asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from training.comparison.report import interval, number, p_text, table
from training.statistics import holm, permuted_difference


class Planned(NamedTuple):
    """A planned comparison: the value of each run of two arms, by seed."""

    name: str
    measure: str
    ours: Mapping[str, float]
    theirs: Mapping[str, float]


def planned_table(primary: Sequence[Planned], secondary: Sequence[Planned] = ()) -> str:
    """Return a table of planned differences; p of several in one list are corrected together.

    Examples:
        >>> runs = {str(seed): float(seed) for seed in range(8)}
        >>> higher = {seed: value + 1.0 for seed, value in runs.items()}
        >>> print(planned_table([Planned("b and a", "area", higher, runs)]))
        | planned | measure | difference | 95 % | p |
        |---|---|---|---|---|
        | b and a | area | +1.000 | [+1.000, +1.000] | 0.008 |
    """
    lines = []
    for family in (primary, secondary):
        found = [permuted_difference(each.ours, each.theirs) for each in family]
        corrected = holm(np.array([each.p for each in found]))
        for each, difference, p in zip(family, found, corrected, strict=True):
            runs = [np.array(list(side.values())) for side in (each.ours, each.theirs)]
            reach = interval(difference.gap, runs, partial(number, sign=True))
            gap = number(difference.gap.value, sign=True)
            lines.append([each.name, each.measure, gap, reach, p_text(float(p))])
    return table(["planned", "measure", "difference", "95 %", "p"], lines)
