"""Make tables and figures of a study, from the rows that ``compare.py`` kept; trains nothing.

    python examples/report.py runs/compare
    python examples/report.py runs/compare --output docs/images/results

Writes ``tables.md``, ``training.png`` (success and average reward over episodes and steps) and
``progress.png`` (greedy success on the validation map over steps). Interquartile means, stratified
bootstrap intervals and probabilities of improvement have a task for each pair of start and goal.
After ``rooms.py`` there is a table of the random rooms, too.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from aggregates import Array, interquartile_mean, probability_of_improvement, stratified_bootstrap
from records import running_mean, write_text_atomically

Method = tuple[str, str]
"""Learner and method."""

PAPER = {
    ("paper", "MPFA-PER"): (0.905, 19, 27.3),
    ("paper", "PER"): (0.855, 29, 31.8),
}
"""Success, collisions of 200 and mean time [s] in the paper's tests."""
GOAL = 0.9


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file; none if there is no such file."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def by_method(rows: Iterable[dict[str, str]]) -> dict[Method, dict[int, list[dict[str, str]]]]:
    """Rows by learner and method, then by seed."""
    found: dict[Method, dict[int, list[dict[str, str]]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        found[row["learner"], row["method"]][int(row["seed"])].append(row)
    return {method: dict(seeds) for method, seeds in found.items()}


def matrix(seeds: dict[int, list[dict[str, str]]], name: str) -> Array:
    """Values of a column, shape ``[seeds, episodes]``; flags are 0 and 1."""
    flags = {"True": 1.0, "False": 0.0}
    return np.array(
        [
            [flags[row[name]] if row[name] in flags else float(row[name]) for row in rows]
            for _, rows in sorted(seeds.items())
        ]
    )


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def outcome_table(
    methods: dict[Method, dict[int, list[dict[str, str]]]],
    *,
    beside: Mapping[Method, tuple[float, int, float]],
) -> str:
    """Success of each seed, and means over the seeds, beside those of another source."""
    rows = []
    for (learner, name), seeds in methods.items():
        success, time = matrix(seeds, "success"), matrix(seeds, "time_s")
        each = ", ".join(f"{value:.1%}" for value in success.mean(axis=1))
        reached = time[success == 1.0]
        rows.append(
            [
                learner,
                name,
                f"{success.mean():.1%}",
                each,
                f"{matrix(seeds, 'collision').mean():.1%}",
                f"{matrix(seeds, 'timeout').mean():.1%}",
                f"{matrix(seeds, 'spl').mean():.3f}",
                f"{reached.mean():.1f}" if reached.size else "",
            ]
        )
    for (source, name), (rate, collisions, seconds) in beside.items():
        of_200 = f"{collisions / 200:.1%}"
        rows.append([source, name, f"{rate:.1%}", "", of_200, "", "", f"{seconds:.1f}"])
    head = ["learner", "method", "success", "of each seed", "collision", "time-out", "SPL"]
    return table([*head, "time [s]"], rows)


def interval_tables(methods: dict[Method, dict[int, list[dict[str, str]]]]) -> str:
    """Interquartile means of SPL and success, and probabilities of improvement on other methods."""
    rng = np.random.default_rng(0)

    def estimate(statistic: Callable[..., float], *scores: Array) -> str:
        low, high = stratified_bootstrap(statistic, *scores, rng=rng)
        return f"{statistic(*scores):.3f} [{low:.3f}, {high:.3f}]"

    names = {method: "/".join(method) for method in methods}
    scores = {
        column: {names[m]: matrix(seeds, column) for m, seeds in methods.items()}
        for column in ("spl", "success")
    }
    rows = [
        [
            name,
            estimate(interquartile_mean, spl),
            estimate(_mean, spl),
            estimate(_mean, scores["success"][name]),
        ]
        for name, spl in scores["spl"].items()
    ]
    parts = [table(["", "SPL, interquartile mean", "SPL, mean", "success, mean"], rows)]
    spl = scores["spl"]
    pairs = [
        [f"{a} > {b}", estimate(probability_of_improvement, spl[a], spl[b])]
        for a in spl
        for b in spl
        if a != b
    ]
    if pairs:
        parts.append(table(["SPL of a pair", "probability of improvement"], pairs))
    return "\n\n".join(parts)


def _mean(scores: Array) -> float:
    return float(scores.mean())


def area_under(steps: Array, values: Array) -> float:
    """Mean height of a curve that starts at zero, over its steps."""
    x, y = np.concatenate(([0.0], steps)), np.concatenate(([0.0], values))
    return float(np.trapezoid(y, x) / x[-1])


def speed_table(curves: dict[Method, dict[int, list[dict[str, str]]]]) -> str:
    """Steps until nine of ten goals are found on the validation map, and area under that curve."""
    rows = []
    for (learner, name), seeds in curves.items():
        firsts, areas = [], []
        for _, found in sorted(seeds.items()):
            steps = np.array([float(row["total_steps"]) for row in found])
            success = np.array([float(row["success"]) for row in found])
            reached = steps[success >= GOAL]
            firsts.append(f"{reached[0]:,.0f}" if reached.size else "never")
            areas.append(area_under(steps, success))
        each = ", ".join(f"{value:.3f}" for value in areas)
        rows.append([learner, name, "; ".join(firsts), f"{np.mean(areas):.3f}", each])
    head = ["learner", "method", f"steps to {GOAL:.0%}, each seed", "area under the curve"]
    return table([*head, "of each seed"], rows)


def draw_training(
    runs: dict[Method, dict[int, list[dict[str, str]]]], path: Path, *, window: int = 20
) -> None:
    """Draw success and average reward of the training episodes, over episodes and over steps."""
    pyplot = _pyplot()
    figure, axes = pyplot.subplots(2, 2, figsize=(10, 6), sharey="row", layout="constrained")
    quantities = (("success", "success rate"), ("average_reward", "average reward per step"))
    for place, (method, seeds) in enumerate(runs.items()):
        for number, (_, rows) in enumerate(sorted(seeds.items())):
            x = np.arange(1.0, len(rows) + 1.0), np.array([float(r["total_steps"]) for r in rows])
            for line, (name, _) in enumerate(quantities):
                values = running_mean(matrix({0: rows}, name)[0], window)
                label = "/".join(method) if number == 0 else None
                for column in (0, 1):
                    axes[line, column].plot(
                        x[column], values, color=f"C{place}", alpha=0.6, lw=1, label=label
                    )
    for line, (_, title) in enumerate(quantities):
        axes[line, 0].set_ylabel(f"{title}, mean of {window}")
    axes[1, 0].set_xlabel("episode")
    axes[1, 1].set_xlabel("step")
    axes[0, 1].legend()
    _finish(figure, axes.flat, path)


def draw_progress(curves: dict[Method, dict[int, list[dict[str, str]]]], path: Path) -> None:
    """Draw greedy success on the validation map over the steps, a line a seed."""
    figure, axis = _pyplot().subplots(figsize=(7, 4), layout="constrained")
    for place, (method, seeds) in enumerate(curves.items()):
        for number, (_, rows) in enumerate(sorted(seeds.items())):
            axis.plot(
                [float(row["total_steps"]) for row in rows],
                [float(row["success"]) for row in rows],
                color=f"C{place}",
                alpha=0.7,
                marker=".",
                label="/".join(method) if number == 0 else None,
            )
    axis.set(xlabel="step", ylabel="greedy success on the validation map", ylim=(-0.02, 1.02))
    axis.legend()
    _finish(figure, [axis], path)


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _finish(figure: Any, axes: Iterable[Any], path: Path) -> None:
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
    _pyplot().close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the rows, write tables and figures.

    Args:
        arguments: The command line.

    Returns:
        Exit status.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the folder of a study")
    parser.add_argument("--output", type=Path, help="folder (default: that of the study)")
    options = parser.parse_args(arguments)
    output = options.output or options.folder
    methods = by_method(read_rows(options.folder / "episodes.csv"))
    if not methods:
        parser.error(f"{options.folder} has no episodes.csv with rows: compare.py writes it")
    training, curves = (
        {
            method: {
                seed: read_rows(options.folder / f"{'-'.join(method)}-{seed}" / name)
                for seed in seeds
            }
            for method, seeds in methods.items()
        }
        for name in ("episodes.csv", "progress.csv")
    )
    output.mkdir(parents=True, exist_ok=True)
    tables = [outcome_table(methods, beside=PAPER)]
    if any(rows for seeds in curves.values() for rows in seeds.values()):
        tables.append(speed_table(curves))
        draw_progress(curves, output / "progress.png")
    rooms = by_method(read_rows(options.folder / "rooms.csv"))
    if rooms:
        tables.append(outcome_table(rooms, beside={}))
    tables.append(interval_tables(methods))
    draw_training(training, output / "training.png")
    text = "\n\n".join(tables)
    write_text_atomically(text + "\n", output / "tables.md")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
