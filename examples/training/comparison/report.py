"""Tables of comparisons in Markdown, from the rows of their episodes and evaluations.

The unit is the run: the episodes of one policy are not independent, as whether it found the path
around a bar decides many of them. Intervals and tests are of the means of runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd

from mpfa_envs.evaluation.results import Interval
from torchrl_mpfa.saving import write_text_atomically
from training import files
from training.comparison.jobs import run_name
from training.figures import Runs, plot_evaluations
from training.records import checked_numbers, checked_words, read_table
from training.statistics import FEWEST, Array, holm, mean_interval, permuted_difference
from training.worlds import family

_WORDS = ("learner", "method", "seed", "world", "episode")
_NUMBERS = ("success", "collision", "timeout", "spl", "time_s")
_OF_EVALUATIONS = ("total_steps", "success")
RATES = (0.9, 0.95)
"""Rates of greedy success in validation of which the time until then is reported."""
ARM = ("learner", "method", "arm")
HOW_TO_READ = """\
The unit is the run: each run counts as one number. *95 %* is Student's interval of a mean, Welch's
of a difference. *p* is that of a two-sided permutation test, corrected for the rows of its table by
Holm's method; runs are paired by seed where both arms have the same six seeds or more. *Least* is
the smallest p that so few runs can have. In a figure, a number in brackets counts runs."""


def write_report(folders: Sequence[Path], output: Path) -> str:
    """Write ``tables.md`` and ``evaluations.png`` of comparisons.

    Args:
        folders: Folders of the comparisons.
        output: Folder of the two files.

    Returns:
        The tables.

    Raises:
        ValueError: If there are no rows, a file is damaged, or the output is no folder.
    """
    files.check_folder(output)
    rows = read_comparisons(folders)
    evaluations = tables_of_runs(rows, files.EVALUATIONS)
    parts = sections(rows)
    if evaluations:
        picture = "![Greedy success in the validation world over actions](evaluations.png)"
        parts += ["## Evaluations during training", rate_table(evaluations), picture]
    text = write_tables(parts, output)
    if evaluations:
        plot_evaluations(evaluations, output / "evaluations.png")
    return text


def write_tables(parts: Sequence[str], output: Path) -> str:
    """Write how to read them, and the parts, in ``tables.md``; return the text."""
    output.mkdir(parents=True, exist_ok=True)
    text = "\n\n".join(part for part in (HOW_TO_READ, *parts) if part)
    write_text_atomically(text + "\n", output / "tables.md")
    return text


def read_comparisons(folders: Sequence[Path]) -> pd.DataFrame:
    """Read the evaluation episodes of comparisons.

    Args:
        folders: Their folders; seeds in two of them are two runs.

    Returns:
        The rows of ``compare.py``; with ``arm`` (learner, method and the arm of the comparison, if
        it has any), ``run`` (its name, unique in its arm), ``path`` (its folder) and ``family``:
        the split of a generator that its world is of, BARN, or the world; comparisons that are
        older than ``physics`` have an empty one.

    Raises:
        ValueError: If there are no rows, or a file lacks columns.
    """
    names = [folder.name for folder in folders]
    tables = []
    for folder in folders:
        found = read_table(folder / files.EPISODES)
        if not len(found):
            continue
        missing = [name for name in (*_WORDS, *_NUMBERS) if name not in found]
        if missing:
            raise ValueError(
                f"{folder / files.EPISODES} has no column {missing[0]}: name the folder of a "
                "comparison, which compare.py made, not that of a run"
            )
        checked_words(found, _WORDS, folder / files.EPISODES)
        for column in _NUMBERS:
            found[column] = checked_numbers(found, column, folder / files.EPISODES)
        for column in ("arm", "physics"):
            found[column] = found[column].fillna("") if column in found else ""
        words = found[["learner", "method", "arm", "seed"]]
        found["path"] = [str(folder / run_name(*each)) for each in words.itertuples(index=False)]
        found["arm"] = words[["learner", "method", "arm"]].agg("/".join, axis=1).str.rstrip("/")
        seed = found["seed"].astype(str)
        name = str(folder) if names.count(folder.name) > 1 else folder.name
        found["run"] = seed if len(folders) == 1 else f"{name}/" + seed
        found["family"] = found["world"].map(family)
        tables.append(found)
    if not tables:
        names = [str(folder) for folder in folders]
        raise ValueError(
            f"{', '.join(names)}: no {files.EPISODES} with rows, which compare.py writes"
        )
    rows = pd.concat(tables, ignore_index=True)
    names = ["arm", "run", "physics", "world", "episode"]
    if (twice := rows.duplicated(names)).any():
        one = ", ".join(f"{name} {value}" for name, value in rows[twice].iloc[0][names].items())
        raise ValueError(f"a run must have one row for each episode, got two of {one}")
    return rows


def tables_of_runs(rows: pd.DataFrame, name: str) -> Runs:
    """Return a table of each run's folder, by arm and run; runs without the table are left out."""
    found: dict[str, dict[str, pd.DataFrame]] = {}
    for (arm, run, path), _ in rows.groupby(["arm", "run", "path"], sort=False):
        file = Path(str(path)) / name
        table = read_table(file)
        if len(table):
            missing = [column for column in _OF_EVALUATIONS if column not in table]
            if missing:
                raise ValueError(f"{file} has no column {missing[0]}")
            for column in _OF_EVALUATIONS:
                table[column] = checked_numbers(table, column, file)
            found.setdefault(str(arm), {})[str(run)] = table
    return found


def sections(rows: pd.DataFrame) -> list[str]:
    """Return headed tables of each physics and family of worlds, and of all worlds together."""
    parts = []
    for physics, driven in rows.groupby("physics", sort=False):
        how = f", {physics!s}" if physics else ""
        for where, found in driven.groupby("family", sort=False):
            parts += [f"## {where}{how}", outcomes(found), differences(found)]
        if driven["family"].nunique() > 1:
            parts += [f"## Success in all worlds{how}", success_table(driven)]
    return parts


def table(head: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    head = list(head)
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def scores(rows: pd.DataFrame, column: str) -> Array:
    """Return the values of a column, shape ``[runs, pairs]``; flags are 0 and 1."""
    matrix = rows.pivot(index="run", columns=["world", "episode"], values=column)
    matrix = matrix.loc[rows["run"].unique()].astype(float)
    if matrix.isna().to_numpy().any():
        raise ValueError(f"the runs {', '.join(matrix.index)} were not tested on the same pairs")
    return matrix.to_numpy()


def outcomes(rows: pd.DataFrame) -> str:
    """Return a table of the success of each arm and of each run, and means over the runs."""
    lines = []
    width = columns_of(rows["arm"])
    for arm, found in rows.groupby("arm", sort=False):
        success, time = scores(found, "success"), scores(found, "time_s")
        reached = time[success == 1.0]
        rates = [f"{scores(found, name).mean():.1%}" for name in ("collision", "timeout")]
        lines.append(
            [
                *cells(str(arm), width),
                f"{success.mean():.1%}",
                _share_interval(success.mean(axis=1)),
                ", ".join(f"{value:.1%}" for value in success.mean(axis=1)),
                *rates,
                f"{scores(found, 'spl').mean():.3f}",
                f"{reached.mean():.1f}" if reached.size else "",
            ]
        )
    head = [*ARM[:width], "success", "95 %", "of each run", "collision", "timeout"]
    return table([*head, "SPL", "time [s]"], lines)


def success_table(rows: pd.DataFrame) -> str:
    """Return the success of each arm in each world or generator, and of its worst run."""
    arms = list(rows["arm"].unique())
    families = {str(name): found for name, found in rows.groupby("family", sort=False)}
    lines = []
    for name, found in (families | {"all": rows}).items():
        driven = {str(arm): each for arm, each in found.groupby("arm")}
        if name == "all":
            # An arm whose runs were not driven in all of them has no mean of all.
            driven = {
                arm: each
                for arm, each in driven.items()
                if (each.groupby("run")["family"].nunique() == len(families)).all()
            }
        lines.append([name, *(_worst(driven[arm]) if arm in driven else "" for arm in arms)])
    return table(["mean of the runs (the worst one)", *arms], lines)


def differences(rows: pd.DataFrame) -> str:
    """Return a table of the differences between arms, tested over runs; empty for one arm."""
    arms = {str(arm): found for arm, found in rows.groupby("arm", sort=False)}
    names = {"success": "success", "SPL": "spl"}
    return difference_table(
        {
            name: {arm: _of_runs(found, column) for arm, found in arms.items()}
            for name, column in names.items()
        }
    )


def difference_table(values: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Return a table of the differences between arms; empty for one arm.

    Args:
        values: The value of each run, by quantity, arm and run.
    """
    arms = list(next(iter(values.values())))
    pairs = list(combinations(arms, 2))
    if not pairs:
        return ""
    signed = partial(number, sign=True)
    columns: list[list[str]] = [[f"{a} − {b}" for a, b in pairs]]
    for of_arms in values.values():
        found = [permuted_difference(of_arms[a], of_arms[b]) for a, b in pairs]
        corrected = holm(np.array([each.p for each in found]))
        sides = [[np.array(list(of_arms[name].values())) for name in pair] for pair in pairs]
        columns += [
            [number(each.gap.value, sign=True) for each in found],
            [interval(each.gap, runs, signed) for each, runs in zip(found, sides, strict=True)],
            [
                _p(p, min(len(pairs) * each.least, 1.0))
                for p, each in zip(corrected, found, strict=True)
            ],
        ]
    head = [word for name in values for word in (name, "95 %", "p")]
    return table(["", *head], list(zip(*columns, strict=True)))


def number(value: float, *, sign: bool = False) -> str:
    """Return a number with three decimals, a large one with one."""
    return f"{value:{'+' if sign else ''}.{3 if abs(value) < 100 else 1}f}"


def _p(corrected: float, least: float) -> str:
    """Return p, and the least that so few runs can have where no difference could be found."""
    return p_text(corrected) + (f" (least {least:.3f})" if least > 0.05 else "")


def p_text(p: float) -> str:
    """Return p with three decimals, never as zero.

    Examples:
        >>> p_text(0.0004), p_text(0.0412)
        ('< 0.001', '0.041')
    """
    return "< 0.001" if p < 0.0005 else f"{p:.3f}"


def rate_table(curves: Mapping[str, Mapping[str, pd.DataFrame]]) -> str:
    """Return actions and time of training until validation first had a rate of success."""
    lines = []
    width = columns_of(curves)
    for arm, runs in curves.items():
        for rate in RATES:
            steps = [_first(found, rate, "total_steps") for found in runs.values()]
            seconds = [_first(found, rate, "trained_for") for found in runs.values()]
            never = sum(math.isinf(each) for each in steps)
            medians = [median_of(each) for each in (steps, seconds)]
            lines.append([*cells(arm, width), f"{rate:.0%}", *medians, f"{never} of {len(runs)}"])
    head = [*ARM[:width], "success", "actions, median of the runs", "seconds of training, median"]
    return table([*head, "never"], lines)


def median_of(values: Iterable[float]) -> str:
    """Return the median over runs, of an even number the lower of the two in the middle.

    Args:
        values: Of each run; infinite where it never came so far.

    Returns:
        The median: "never" if more than half of the runs never came so far, empty for NaN.

    Examples:
        >>> median_of([4000.0, 2000.0, math.inf, math.inf]), median_of([2000.0, math.inf, math.inf])
        ('4,000', 'never')
    """
    middle = float(np.quantile(np.array(list(values)), 0.5, method="inverted_cdf"))
    if math.isnan(middle):
        return ""
    return "never" if math.isinf(middle) else f"{middle:,.0f}"


def columns_of(arms: Iterable[str]) -> int:
    """Columns that the names of arms take: two, or three where a comparison has arms."""
    return max(arm.count("/") for arm in arms) + 1


def cells(arm: str, width: int) -> list[str]:
    """The name of an arm in so many columns."""
    return [*arm.split("/"), *[""] * width][:width]


def interval(found: Interval, runs: Sequence[Array], form: Callable[[float], str]) -> str:
    """Return a 95 % interval, or in words why there is none.

    Args:
        found: The interval.
        runs: Values of the runs of one arm, or of each of two.
        form: Function that writes an end.
    """
    fewest = min(map(len, runs))
    if fewest < FEWEST:
        return "one run" if fewest == 1 else "two runs: no interval"
    # Runs that all end alike, at 0 % or 100 % as a rule, do not show how much others differ.
    if not any(np.ptp(each) for each in runs):
        return "none, no spread"
    return f"[{form(found.low)}, {form(found.high)}]"


def _share_interval(runs: Array) -> str:
    """Return Student's interval of the mean of shares, which lies within 0 and 1."""
    found = mean_interval(runs)
    return interval(found, [runs], lambda end: f"{min(max(end, 0.0), 1.0):.1%}")


def _of_runs(rows: pd.DataFrame, column: str) -> dict[str, float]:
    """Return the mean of a column for each run, by the name of the run."""
    names = map(str, rows["run"].unique())
    return dict(zip(names, scores(rows, column).mean(axis=1).tolist(), strict=True))


def _first(found: pd.DataFrame, rate: float, column: str) -> float:
    """Value of a column where a rate of success is first reached; infinite if it never is."""
    reached = found[found["success"] >= rate]
    if not len(reached):
        return math.inf
    return float(reached[column].iloc[0]) if column in found else math.nan


def _worst(rows: pd.DataFrame) -> str:
    """Mean success of the runs of an arm, and in brackets the run with the lowest."""
    of_runs = scores(rows, "success").mean(axis=1)
    if len(of_runs) == 1:
        return f"{of_runs[0]:.1%}"
    name = rows["run"].unique()[of_runs.argmin()]
    return f"{of_runs.mean():.1%} ({name}: {of_runs.min():.1%})"
