"""Table G as a page and two figures: differences of methods, paired by buffer and seed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from textwrap import fill

import numpy as np
import pandas as pd

from benchmarks.values.arms import AGAINST, ARMS, LEFT_OUT, PAIRS, PLANNED
from benchmarks.values.capture import REWARDS
from benchmarks.values.frozen import FrozenBuffer
from benchmarks.values.learning import compared
from mpfa_envs.render.charts import finish, looks, new_figure
from torchrl_mpfa.saving import write_text_atomically
from training.comparison.report import table
from training.statistics import holm, mean_interval, sign_p

SHOWN = ("mpfa_per", AGAINST, "mpfa_plus", "mpf_per", "mixture", "lap", "uniform")
"""Arms whose curves are shown."""
HEAD = """\
- **Question.** Which replay learns the values of a fixed policy sooner from a frozen buffer?
- **Answer.** With sparse rewards, replay by several signals: the reward does it. With a reward for
  every step no difference to the TD error alone was found. More updates help with both.
- **How sure.** Five of the six planned differences survive the correction, and their p are final.
  All others are exploratory.
- **Changed after the start.** The table ended with five seeds for each buffer instead of ten
  ([why](../study.md#what-more-runs-could-not-decide))."""
_DPI = 160


def write_report(rows: pd.DataFrame, buffers: Sequence[FrozenBuffer], folder: Path) -> list[Path]:
    """Write ``G.md``, ``G_curves.png`` and ``G_arms.png``."""
    found = [folder / name for name in ("G.md", "G_curves.png", "G_arms.png")]
    write_text_atomically(page(rows, buffers), found[0])
    plot_curves(rows, found[1])
    plot_arms(rows, found[2])
    return found


def page(rows: pd.DataFrame, buffers: Sequence[FrozenBuffer]) -> str:
    """Return the tables in Markdown."""
    planned = rows[rows["method"].isin((*PLANNED, AGAINST))]
    seeds = rows.groupby(["buffer", "method"])["seed"].nunique()
    count = " to ".join(str(number) for number in sorted({seeds.min(), seeds.max()}))
    parts = [
        "# G: Which replay learns values sooner?",
        HEAD,
        f"{rows['buffer'].nunique()} buffers, {count} seeds in each. "
        f"Differences to `{AGAINST}` are of the same buffers and seeds, with 95 % intervals over "
        "buffers. RMSE is in per cent of that of PER. [What is measured](../values.md).",
        "## Planned comparisons",
        planned_table(planned),
        "## All arms",
        "Numbers are means over all marks. The columns `sparse` and `dense` have the RMSE to long "
        "training in six buffers each. Arms that were not planned are exploratory and not "
        "corrected.",
        arm_table(rows),
        "By the returns, and what was sampled at the end:",
        returns_table(rows),
        table(("left out", "why"), [[f"`{name}`", why] for name, why in LEFT_OUT.items()]),
        "## Pairs",
        "Pairs have about the same effective sample, or one thing changed. They are exploratory "
        "and not corrected. `la3p` and `uniform_halves` update the critics twice where others do "
        "once, on half as many transitions.",
        pair_table(rows),
        "## Fading",
        "RMSE to long training after so many updates.",
        fading_table(planned),
        "## By buffer",
        buffer_table(planned),
        "## The two references",
        "Long training with uniform replay against what the policy got in episodes of its own.",
        reference_table(buffers),
        "## Figures",
        "![RMSE beside PER over updates](G_curves.png)",
        "![RMSE beside PER of all arms](G_arms.png)",
    ]
    kept = ("|", "#", "!", "- ")
    lines = [part if part.startswith(kept) else fill(part, 120) for part in parts]
    return "\n\n".join(lines) + "\n"


def planned_table(rows: pd.DataFrame) -> str:
    """Return the planned comparisons, corrected for each other."""
    found = differences(rows, against=AGAINST)
    there = found.loc[[name for name in PLANNED if name in found.index]]
    corrected = holm(there["rmse_p"].to_numpy())
    head = ("", "buffers", "RMSE, long training", "p", "corrected", "rank correlation", "p")
    cells = [
        [
            f"{name} − {AGAINST}",
            f"{row.units:.0f}",
            _share(row, "rmse"),
            _p(row.rmse_p),
            _p(p),
            _gap(row, "rank"),
            _p(row.rank_p),
        ]
        for (name, row), p in zip(there.iterrows(), corrected, strict=True)
    ]
    return table(head, cells)


def arm_table(rows: pd.DataFrame) -> str:
    """Return all arms by long training, the best first."""
    found = differences(rows, against=AGAINST)
    parts = [
        differences(rows[rows["buffer"].str.startswith(reward)], against=AGAINST)
        for reward in REWARDS
    ]
    head = ("", "RMSE, long training", "p", *REWARDS, "rank correlation")
    cells = [
        [
            f"`{name}`",
            _share(row, "rmse"),
            _p(row.rmse_p),
            *(_share(_row(part, name), "rmse") for part in parts),
            _gap(row, "rank"),
        ]
        for name, row in found.iterrows()
    ]
    return table(head, cells)


def returns_table(rows: pd.DataFrame) -> str:
    """Return all arms by the returns, and what they sample at the end, in the same order."""
    sampled = rows[(rows["method"] == AGAINST) & (rows["updates"] == rows["updates"].max())]
    head = ("", "RMSE, returns", "rank correlation, returns", "effective sample", "goals sampled")
    cells = [
        [
            f"`{name}`",
            _share(row, "returns_rmse"),
            _gap(row, "returns_rank"),
            f"{row.effective:.0%}",
            f"{row.goals:.1%}",
        ]
        for name, row in differences(rows, against=AGAINST).iterrows()
    ]
    own = [f"{sampled['effective'].mean():.0%}", f"{sampled['goals'].mean():.1%}"]
    cells.append([f"`{AGAINST}`", "", "", *own])
    return table(head, cells)


def pair_table(rows: pd.DataFrame) -> str:
    """Return the differences of :data:`PAIRS`."""
    head = ("", "effective samples", "RMSE, long training", "p", *REWARDS, "RMSE, returns")
    cells = []
    for first, second in PAIRS:
        two = rows[rows["method"].isin((first, second))]
        if two["method"].nunique() < len((first, second)):
            continue
        parts = [two, *(two[two["buffer"].str.startswith(reward)] for reward in REWARDS)]
        found, *by_reward = (_row(differences(part, against=second), first) for part in parts)
        sampled = two[two["updates"] == two["updates"].max()].groupby("method")["effective"].mean()
        cells.append(
            [
                f"`{first}` − `{second}`",
                f"{sampled[first]:.0%}, {sampled[second]:.0%}",
                _share(found, "rmse"),
                _p(found["rmse_p"]),
                *(_share(each, "rmse") for each in by_reward),
                _share(found, "returns_rmse"),
            ]
        )
    return table(head, cells)


def fading_table(rows: pd.DataFrame) -> str:
    """Return the differences of the planned arms after each number of updates."""
    marks = sorted(rows["updates"].unique())
    by_mark = [differences(rows, against=AGAINST, at=mark) for mark in marks]
    cells = [
        [f"`{name}`", *(_share(_row(found, name), "rmse") for found in by_mark)]
        for name in PLANNED
        if name in by_mark[0].index
    ]
    return table(("", *(f"{mark} updates" for mark in marks)), cells)


def buffer_table(rows: pd.DataFrame) -> str:
    """Return the RMSE of PER, and the differences of the planned arms, in each buffer."""
    gaps = paired(rows, "rmse", against=AGAINST)
    of_per = rows[rows["method"] == AGAINST].groupby("buffer")["rmse"].mean()
    there = [name for name in PLANNED if name in gaps]
    cells = [
        [name, f"{of_per[name]:.3f}", *(f"{np.expm1(row[arm]):+.1%}" for arm in there)]
        for name, row in zip(map(str, gaps.index), gaps.to_dict("records"), strict=True)
    ]
    return table(("buffer", "RMSE of PER", *there), cells)


def reference_table(buffers: Sequence[FrozenBuffer]) -> str:
    """Return how far long training and Monte Carlo returns agree."""
    cells = []
    for each in buffers:
        rmse, bias, rank = compared(each.returns["long"], each.returns["value"])
        deviation = float(each.returns["value"].std())
        numbers = [each.spread, float(each.value.std()), deviation, rmse, bias]
        cells.append([each.name, *(f"{number:.2f}" for number in numbers), f"{rank:.2f}"])
    head = (
        *("buffer", "spread of long critics", "deviation of their values", "of returns"),
        *("RMSE to returns", "bias", "rank correlation"),
    )
    return table(head, cells)


def plot_curves(rows: pd.DataFrame, path: Path) -> None:
    """Plot the RMSE relative to PER over updates, means over buffers with 95 % intervals."""
    figure, axes = new_figure(2, 2, panel=(3.8, 2.4), sharex=True, sharey="col")
    marks = sorted(rows["updates"].unique())
    references = {"rmse": "against long training", "returns_rmse": "against returns"}
    for axis, (column, reward) in zip(axes, product(references, REWARDS), strict=True):
        found = rows[rows["buffer"].str.startswith(reward)]
        at = [paired(found, column, against=AGAINST, at=mark) for mark in marks]
        for arm, style in looks(name for name in SHOWN if name in at[0] or name == AGAINST).items():
            if arm == AGAINST:
                axis.axhline(0.0, **style, label=arm)
                continue
            ends = [mean_interval(gaps[arm].dropna().to_numpy()) for gaps in at]
            mean, low, high = 100 * np.expm1([(e.value, e.low, e.high) for e in ends]).T
            axis.plot(marks, mean, **style, label=arm)
            axis.fill_between(marks, low, high, color=style["color"], alpha=0.12, lw=0)
        axis.set_title(f"{reward} rewards, {references[column]}", fontsize="medium")
        axis.set_xscale("log", base=2)
        axis.set_xticks(marks, [str(mark) for mark in marks])
    figure.supxlabel("updates", fontsize="medium")
    figure.supylabel("RMSE, minus PER's [%]", fontsize="medium")
    axes[1].legend(fontsize="x-small", frameon=False, ncols=2)
    finish(figure, axes, path, dpi=_DPI)


def plot_arms(rows: pd.DataFrame, path: Path) -> None:
    """Plot RMSE and rank correlation of all arms relative to PER, with 95 % intervals."""
    found = differences(rows, against=AGAINST)[::-1]
    figure, axes = new_figure(1, 2, panel=(3.2, 0.17 * len(found) + 0.8), sharey=True)
    heights = np.arange(len(found))
    colors = [style["color"] for style in looks(found.index).values()]
    for axis, column in zip(axes, ("rmse", "rank"), strict=True):
        scale = 1.0 if column in RANKS else 100.0
        mean, low, high = (
            scale * found[name].to_numpy() for name in (column, f"{column}_low", f"{column}_high")
        )
        axis.axvline(0.0, color="0.5")
        axis.hlines(heights, low, high, color=colors, alpha=0.6)
        axis.scatter(mean, heights, s=9, color=colors)
    axes[0].set_yticks(heights, found.index, fontsize="x-small")
    axes[0].set_ylim(-0.7, len(found) - 0.3)
    axes[0].set_xlabel("RMSE beside PER [%]")
    axes[1].set_xlabel("rank correlation, minus that of PER")
    finish(figure, axes, path, dpi=_DPI)


def missing(rows: pd.DataFrame, buffers: Sequence[str], seeds: int) -> int:
    """Count the trainings of table G that have no rows."""
    made = rows[["buffer", "method", "seed"]].drop_duplicates()
    return len(ARMS) * len(buffers) * seeds - len(made)


def _row(found: pd.DataFrame, name: object) -> pd.Series:
    return found.loc[[name]].iloc[0]


def _share(row: pd.Series, column: str) -> str:
    ends = f"[{row[f'{column}_low']:+.1%}, {row[f'{column}_high']:+.1%}]"
    return f"{row[column]:+.1%} {ends}"


def _gap(row: pd.Series, column: str) -> str:
    ends = f"[{row[f'{column}_low']:+.3f}, {row[f'{column}_high']:+.3f}]"
    return f"{row[column]:+.3f} {ends}"


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


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
