"""The paper's figures, one function each, from the rows of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.study.paper import CLAIMS, CURVES, NAMES, PHIS, TABLE_4
from mpfa_envs.render.charts import finish, look, new_figure
from training.figures import Runs, running_mean

MAPS = "ABCD"
_EPISODES = 10
"""Of the running mean of a reward."""
_BLOCK = 10_000
"""Steps of a point in Fig. 13."""


def plot_paper(episodes: Runs, updates: Runs, folder: Path) -> list[Path]:
    """Plot all figures of which there are runs."""
    arms = tuple(f"phi{phi}" for phi in PHIS)
    figures: dict[str, tuple[Runs, Sequence[str], Callable[[Path], None]]] = {
        "figure_3": (updates, ("per",), lambda path: plot_figure_3(updates, episodes, path)),
        "figure_5": (episodes, arms, lambda path: plot_figure_5(episodes, path)),
        **{
            f"figure_{number}": (
                episodes,
                methods,
                partial(plot_rewards_by_map, episodes, methods),
            )
            for number, methods in CURVES.items()
        },
        "figure_13": (
            updates,
            tuple(TABLE_4),
            lambda path: plot_figure_13(updates, tuple(TABLE_4), path),
        ),
        "claims": (updates, CLAIMS, lambda path: plot_claims(updates, CLAIMS, path)),
    }
    made = []
    for name, (runs, wanted, plot) in figures.items():
        if any(each in runs for each in wanted):
            plot(folder / f"{name}.png")
            made.append(folder / f"{name}.png")
    return made


def plot_figure_3(updates: Runs, episodes: Runs, path: Path, *, method: str = "per") -> None:
    """Plot Fig. 3, TD error and average reward of PER, over episodes and over steps."""
    figure, axes = new_figure(2, 2, panel=(5, 3), sharey="row")
    for column, x in enumerate(("episode", "total_steps")):
        errors = [_by(each, x, "td_error") for each in updates[method].values()]
        rewards = [_by(each, x, "average_reward") for each in episodes[method].values()]
        for axis, runs in zip(axes[column::2], (errors, rewards), strict=True):
            _plot_runs(axis, runs, 0, NAMES[method], single=True)
    axes[0].set(ylabel="|TD error| of the batch", title="every run, and their mean")
    axes[2].set(ylabel=f"reward per step, mean of {_EPISODES}", xlabel="episode")
    axes[3].set(xlabel="step")
    axes[3].locator_params(axis="x", nbins=5)
    axes[1].locator_params(axis="x", nbins=5)
    finish(figure, axes, path)


def plot_figure_5(episodes: Runs, path: Path) -> None:
    """Plot Fig. 5, the average reward in map A with phi = 2, 3 and 4."""
    figure, (axis,) = new_figure(panel=(7, 4))
    for place, phi in enumerate(PHIS):
        runs = _rewards(episodes.get(f"phi{phi}", {}), MAPS[0])
        _plot_runs(axis, runs, place, f"φ = {phi}")
    axis.set(xlabel="episode", ylabel=f"reward per step, mean of {_EPISODES}")
    axis.legend()
    finish(figure, [axis], path)


def plot_rewards_by_map(episodes: Runs, methods: Sequence[str], path: Path) -> None:
    """Plot Figs. 8 to 11, the average reward of methods in each of the maps A to D."""
    figure, axes = new_figure(2, 2, panel=(5, 3.5), sharey=True)
    for axis, world in zip(axes, MAPS, strict=True):
        # A method has one color in all four figures.
        for method in methods:
            runs = _rewards(episodes.get(method, {}), world)
            _plot_runs(axis, runs, list(NAMES).index(method), NAMES[method])
        axis.set(title=f"map {world}", xlabel="episode in this map")
    for axis in axes[::2]:
        axis.set_ylabel(f"reward per step, mean of {_EPISODES}")
    axes[0].legend()
    finish(figure, axes, path)


def plot_figure_13(updates: Runs, methods: Sequence[str], path: Path) -> None:
    """Plot Fig. 13, the total reward of every 10,000 steps."""
    figure, (axis,) = new_figure(panel=(8, 5))
    for method in methods:
        runs = [reward_of_blocks(each) for each in updates.get(method, {}).values()]
        _plot_runs(axis, runs, list(NAMES).index(method), NAMES[method], marker=".")
    axis.set(xlabel="step", ylabel=f"total reward of {_BLOCK:,} steps")
    axis.legend()
    finish(figure, [axis], path)


def plot_claims(updates: Runs, methods: Sequence[str], path: Path) -> None:
    """Plot what Section 2.4 says of PER: old TD errors, and a batch unlike the buffer."""
    panels = {
        "td_error_age": "age of the sampled TD errors [updates]",
        "positive_buffer": "positive transitions in the buffer",
        "positive_batch": "positive transitions in the batch",
    }
    figure, axes = new_figure(1, 3, panel=(13 / 3, 4))
    for axis, (column, label) in zip(axes, panels.items(), strict=True):
        for method in methods:
            runs = [_by(each, "total_steps", column) for each in updates.get(method, {}).values()]
            _plot_runs(axis, runs, list(NAMES).index(method), NAMES[method])
        axis.set(xlabel="step", ylabel=label)
        axis.locator_params(axis="x", nbins=5)
    low, high = zip(*(axis.get_ylim() for axis in axes[1:]), strict=True)
    for axis in axes[1:]:
        axis.set_ylim(min(low), max(high))
    axes[0].legend()
    finish(figure, axes, path)


def reward_of_blocks(updates: pd.DataFrame, *, steps: int = _BLOCK) -> pd.Series[Any]:
    """Total reward of every so many steps of a run, whole blocks alone."""
    block = -(-updates["total_steps"] // steps)
    whole = updates[block * steps <= updates["total_steps"].max()]
    rewards = whole.groupby(block[whole.index] * steps)["reward"].sum()
    rewards.index.name = None
    return rewards


def _rewards(runs: Mapping[str, pd.DataFrame], world: str) -> list[pd.Series[Any]]:
    """Reward per step of each run over its episodes in a world, smoothed."""
    found = []
    for table in runs.values():
        here = table[table["world"] == world].reset_index(drop=True)
        if len(here):
            found.append(_by(here.assign(number=here.index + 1), "number", "average_reward"))
    return found


def _by(table: pd.DataFrame, x: str, y: str) -> pd.Series[Any]:
    """A column over another one; rewards of episodes as a running mean."""
    values = table[y]
    if "success" in table:
        values = pd.Series(running_mean(values, _EPISODES))
    return pd.Series(values.to_numpy(), index=table[x].to_numpy()).groupby(level=0).last()


def _plot_runs(
    axis: Any,
    runs: Sequence[pd.Series[Any]],
    place: int,
    label: str,
    *,
    single: bool = False,
    marker: str = "",
) -> None:
    """Plot the mean of runs, and each of them thinly or one standard deviation around it."""
    if not runs:
        return
    # Runs are as long as their episodes: where they end, the mean would be of a few of them.
    last = min(run.index.max() for run in runs)
    table = pd.concat(runs, axis=1).sort_index().interpolate(limit_area="inside").loc[:last]
    mean, spread = table.mean(axis=1), table.std(axis=1)
    style = look(place)
    if single:
        axis.plot(table.index, table, **style, alpha=0.3, lw=0.8)
    elif len(runs) > 1:
        color = style["color"]
        axis.fill_between(table.index, mean - spread, mean + spread, color=color, alpha=0.15, lw=0)
    axis.plot(table.index, mean, **style, marker=marker, label=f"{label} ({len(runs)})")
