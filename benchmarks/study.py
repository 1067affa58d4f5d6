"""Make the pictures of the study's tables, the cliffwalk, MuJoCo and sparse rewards, of kept rows.

    python -m benchmarks.study              to docs/results/study and docs/images
    python -m benchmarks.study L --output runs/new

A picture has a row of two panels for each group of arms: on the left mean curves of the runs, on
the right the measure of each run, its mean and Student's 95 % interval.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mpfa_envs.render.charts import Curve, draw_seeds, finish, looks, new_figure, seed_band
from training.comparison.scores import runs_by_task
from training.figures import plot_scores
from training.files import run_script
from training.records import area_under, read_table
from training.statistics import mean_interval

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "docs/results"
_FOUR = {
    **{"MPFA-PER": "mpfa_per", "PER": "per", "mpfa_plus": "mpfa_plus"},
    **{"MPF-PER": "mpf_per", "LAP": "lap", "uniform": "uniform"},
}
_HALVES = {"LA3P": "la3p", "uniform_halves": "uniform_halves"}


def _arms(form: str, *names: str) -> dict[str, str]:
    """Arms by the names of their methods, which stand for {} in the form."""
    return {name: form.format({**_FOUR, **_HALVES}[name]) for name in names}


_THREE = ("MPFA-PER", "PER", "uniform")
_KINDS = {
    "MPFA-PER": "mpfa_per/mpfa_per_{}",
    "MPFA-PER, floor of 0.2": "mpfa_per/floor_{}",
    "PER": "per/per_{}",
    "mixture": "mpfa_plus/mixture_{}",
}
PANELS: dict[str, dict[str, dict[str, str]]] = {
    "B": {
        "TD3": _arms("dense/td3/{}", *_FOUR),
        "TD3, two updates on half batches": _arms("dense/td3/{}", *_HALVES),
        "DDPG": _arms("dense/ddpg/{}", "MPFA-PER", "PER", "mpfa_plus", "uniform"),
    },
    "C": {
        "TD3": _arms("sparse/td3/{}", "MPFA-PER", "PER", "mpfa_plus", "MPF-PER", "uniform"),
        "TD3, losses that bend": {
            "LAP": "sparse/td3/lap",
            "LAP, floor at the median": "sparse/td3/lap/median",
            "PAL": "sparse/td3/pal",
            "uniform": "sparse/td3/uniform",
        },
        "DDPG": _arms("sparse/ddpg/{}", *_THREE),
    },
    "D": {
        f"each transition replayed {volume} times": _arms(f"sparse/td3/{{}}{end}", *_THREE)
        for volume, end in ((8, "/v8"), (32, ""), (128, "/v128"))
    },
    "F": {
        task: _arms(f"gym/{task}/{{}}", "MPFA-PER", "PER", "mpfa_plus", "uniform")
        for task in ("Pendulum-v1", "MountainCarContinuous-v0", "Reacher-v5")
    },
    "H": {
        f"effective sample of {share} %": {
            name: f"experiments/td3/{arm.format(strength)}" for name, arm in _KINDS.items()
        }
        for share, strength in ((80, "weak"), (50, "medium"), (20, "strong"))
    },
    "I": {
        "noisy rewards": {
            **_arms("experiments/td3/{}/noise", "MPFA-PER", "PER", "mpfa_plus"),
            "UPER": "experiments/td3/uper/noise",
            **_arms("experiments/td3/{}/noise", "uniform"),
        }
    },
    "J": {
        "two updates on half batches": {
            "LA3P, actor by low priority": "experiments/td3/la3p/inverse",
            "LA3P, actor from any row": "experiments/td3/la3p/apart",
            "LA3P, actor by priority": "experiments/td3/la3p/together",
            "uniform_halves": "experiments/td3/uniform_halves",
        }
    },
    "K": {
        "MPFA-PER": {
            "MPFA-PER, all kinds alike": "experiments/dense/td3/mpfa_per",
            "MPFA-PER, by learnability": "experiments/dense/td3/mpfa_per/learnable",
        }
    },
    "L": {
        "goals as they were": _arms("experiments/td3/{}", *_THREE),
        "goals in hindsight as well": {
            "MPFA-PER with hindsight": "experiments/td3/mpfa_per/hindsight",
            "PER with hindsight": "experiments/td3/per/hindsight",
            "HER": "experiments/td3/her",
        },
    },
}
"""Groups of arms by the table of the study, then by the title of their panels."""
_SAMPLERS = ("MPFA-PER", "proportional PER", "rank-based PER", "greedy oracle", "uniform")


def read_curves(table: str) -> dict[str, list[Curve]]:
    """Read the curves of the runs of a table, by arm and in the order of seeds."""
    rows = read_table(KEPT / "study/curves.csv.gz")
    rows = rows[rows["table"] == table]
    found: dict[str, list[Curve]] = {}
    for (arm, _), run in rows.groupby(["arm", "seed"]):
        found.setdefault(str(arm), []).append((run["total_steps"], run["success"]))
    return found


def plot_table(table: str, path: Path) -> None:
    """Plot curves of a table and the area of each of its runs."""
    curves, groups = read_curves(table), PANELS[table]
    tall = max(2.5, 0.36 * max(map(len, groups.values())) + 0.7)
    figure, axes = new_figure(len(groups), 2, panel=(3.6, tall), sharex="col")
    for left, right, (title, arms) in zip(axes[::2], axes[1::2], groups.items(), strict=True):
        for height, (name, style) in enumerate(looks(arms).items()):
            runs = curves[arms[name]]
            steps, mean, _, _ = seed_band(runs)
            left.plot(steps / 1000, mean, **style, label=name)
            areas = np.array([area_under(*run) for run in runs])
            found, color = mean_interval(areas), style["color"]
            right.plot(areas, np.full(len(areas), -height), ".", color=color, alpha=0.35)
            right.plot([found.low, found.high], [-height] * 2, **style, lw=2)
            right.plot(found.value, -height, "o", color=color)
        left.set(ylim=(-0.02, 1.02), ylabel="score" if table == "F" else "success")
        left.set_title(title, loc="left", fontsize="medium")
        if len({look["color"] for look in looks(arms).values()}) < len(arms):
            left.legend(fontsize="x-small", frameon=False)
        shown = [f"{name} ({len(curves[arm])})" for name, arm in arms.items()]
        right.set_yticks([-height for height in range(len(arms))], shown)
        right.set_ylim(0.6 - len(arms), 0.6)
    axes[-2].set_xlabel("thousand actions")
    axes[-1].set_xlabel("area; a dot is a run")
    finish(figure, axes, path, dpi=160)


def plot_cliffwalk(path: Path) -> None:
    """Plot the updates that the cliffwalk takes over its length, median and range of seeds."""
    rows = read_table(KEPT / "cliffwalk.csv")
    figure, (axis,) = new_figure(panel=(7.0, 4.2))
    for name, style in looks(_SAMPLERS).items():
        updates = rows[rows["replay"] == name].groupby("length")["updates"]
        found = updates.agg(["median", "min", "max"])
        axis.plot(found.index, found["median"], **style, label=name)
        axis.fill_between(found.index, found["min"], found["max"], color=style["color"], alpha=0.2)
    sizes = rows.groupby("length")["transitions"].first()
    axis.plot(sizes.index, sizes, ":", color="0.3", label="transitions")
    axis.set(yscale="log", xlabel="states", ylabel="updates")
    axis.legend(frameon=False)
    finish(figure, [axis], path)


def plot_mujoco(path: Path) -> None:
    """Plot the scores of each task of MuJoCo over the steps."""
    plot_scores(runs_by_task([KEPT / "mujoco.csv"]), path, columns=1)


def plot_goals(path: Path) -> None:
    """Plot the share of goals reached in each task of gymnasium-robotics over the steps."""
    from benchmarks.goals.arms import ARMS, PLANNED, SB3

    tasks = runs_by_task([KEPT / "goals.csv"])
    figure, (*axes, names) = new_figure(2, 2, panel=(3.5, 2.9))
    for axis, task in zip(axes, PLANNED, strict=True):
        curves = {arm: list(tasks[task][arm].values()) for arm in (*ARMS, SB3)}
        draw_seeds(axis, curves, limits=(0.0, 1.0))
        axis.set(xlabel="steps", ylabel="episodes at their goal", title=task)
        # Names are the same in all of them.
        axis.get_legend().remove()
    names.axis("off")
    names.legend(*axes[-1].get_legend_handles_labels(), loc="center", frameon=False)
    finish(figure, axes, path)


def plot_sparse(path: Path) -> None:
    """Plot success in validation worlds of sparse rewards: near goals, simple, before."""
    tasks = runs_by_task([KEPT / "sparse.csv"])
    runs = dict(tasks["near goals, validation"])
    for regime in ("simple", "before"):
        [runs[f"PER with hindsight, {regime}"]] = tasks[f"{regime}, validation"].values()
    curves = {name: list(of_method.values()) for name, of_method in runs.items()}
    figure, (axis,) = new_figure(panel=(6.6, 4.2))
    draw_seeds(axis, curves, limits=(0.0, 1.0))
    axis.set(xlabel="actions", ylabel="success in validation worlds")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    finish(figure, [axis], path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the pictures that are asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.study", description=__doc__)
    images = {
        "cliffwalk": plot_cliffwalk,
        "mujoco": plot_mujoco,
        "goals": plot_goals,
        "sparse": plot_sparse,
    }
    known = [*PANELS, *images]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"among {', '.join(known)}")
    parser.add_argument("--output", type=Path, default=None, help="folder")
    options: Any = parser.parse_args(arguments)
    if unknown := [name for name in options.names if name not in known]:
        parser.error(f"there is no picture {unknown[0]!r}: choose from {', '.join(known)}")
    for name in options.names or known:
        if name in images:
            images[name]((options.output or ROOT / "docs/images") / f"{name}.png")
        else:
            plot_table(name, (options.output or KEPT / "study") / f"{name}.png")
    return 0


if __name__ == "__main__":
    run_script(main)
