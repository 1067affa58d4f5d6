"""Measure how strongly the methods of table C of the study prioritize, in runs of its sparse task.

    python -m benchmarks.study strength    seven methods, three seeds
    python -m benchmarks.study strength --methods per --seeds 1700    one run, half a minute
    python -m benchmarks.study strength --show docs/results/strength.csv    the table of kept rows

Writes ``strength.csv``: a row for each run and each number of actions in :data:`MARKS`. Its columns
are the fields of :class:`Row`. Training is eager and without evaluations, otherwise as in the
study; the seeds are none of its tables. It continues where it was stopped.
"""

from __future__ import annotations

import argparse
import copy
import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import cast

import pandas as pd
import torch
from tensordict import TensorDict

from benchmarks.study.protocol import SPARSE
from mpfa_envs import RandomMirror
from torchrl_mpfa import EntropyFusion, SignalSampler, TD3Learner
from training.comparison.report import table
from training.run.hooks import Hook
from training.run.loop import TrainingRun
from training.settings.command_line import composed
from training.settings.train import register

METHODS = ("per", "mpfa_per", "mpfa_plus", "mpf_per", "lap", "uniform", "pal")
SEEDS = (1700, 1701, 1702)
MARKS = (1_200, 4_000, 8_000, 16_000, 24_000)
"""Actions after which the buffer is looked at, the first time before there are goals."""


@dataclass(frozen=True)
class Row:
    """A buffer after so many actions, each of which is a transition in it."""

    method: str
    seed: int
    actions: int
    goals: int
    """Transitions that reach the goal."""
    effective: float
    """Effective sample size of the sampling probabilities, as a share of the buffer."""
    goals_sampled: float
    """Share of a batch that reaches the goal."""
    td_error: float
    """Median |TD error| by the networks as they are, without target noise, in units of reward."""
    mirror: float
    """Rank correlation of the |TD error| of a transition and of its mirror image."""
    reward_weight: float
    """Weight of the reward among the signals (Eq. 18); NaN without entropy weights."""


def measure(run: TrainingRun) -> Row:
    """Look at a run as it is now."""
    size, sampler = len(run.buffer), run.buffer.sampler
    chance = torch.ones(size, dtype=torch.double)
    weight = math.nan
    if isinstance(sampler, SignalSampler):
        chance = sampler.priorities()[:size] ** sampler.alpha
        if isinstance(sampler.fusion, EntropyFusion):
            weight = sampler.weights["reward"]
    chance /= chance.sum()
    rows = run.buffer.storage[:size]
    goal = rows["next", "reward"].reshape(-1) > 0
    # The map is what the robots of the regime remember; the run's own generator is not touched.
    mirror = RandomMirror(memory="map", chance=1.0, generator=torch.Generator())
    mirrored = mirror(rows.clone())
    errors, others = td_errors(run, rows), td_errors(run, mirrored)
    return Row(
        method=run.settings.method.name,
        seed=run.settings.seed,
        actions=run.actions,
        goals=int(goal.sum()),
        effective=float(1 / (chance.square().sum() * size)),
        goals_sampled=float(chance[goal].sum()),
        td_error=float(errors.median()),
        mirror=pd.Series(errors).corr(pd.Series(others), method="spearman"),
        reward_weight=weight,
    )


def td_errors(run: TrainingRun, rows: TensorDict) -> torch.Tensor:
    """|TD error| of each transition, shape ``[N]``; the run is left as it is."""
    loss = copy.deepcopy(cast(TD3Learner, run.learner).loss)
    loss.signals, loss.policy_noise = ("td_error",), 0.0
    batch = rows.clone()
    # Noise is sampled whatever its size.
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        loss.losses(batch, trains="critic")
    return batch["signals", "td_error"]


def rows_of(method: str, seed: int) -> Iterator[Row]:
    """Train a run and look at it on the way."""
    with tempfile.TemporaryDirectory() as folder:
        own = ("learner=td3", "learner.compile=false", "evaluation.every=0", f"method={method}")
        (settings,) = composed([*SPARSE, *own, f"seed={seed}", f"run_dir={folder}"])
        found: list[Row] = []

        class Look(Hook):
            def on_iteration(self, run: TrainingRun) -> None:
                if run.actions in MARKS:
                    found.append(measure(run))

        if not TrainingRun(settings, Path(folder), hooks=[Look()]).train():
            sys.exit("stopped: the run in progress is not kept")
    yield from found


def tables_of(rows: pd.DataFrame) -> str:
    """Two Markdown tables: means, lowest and highest once goals are known; weights over time."""
    late, fused = rows[rows["actions"] > MARKS[0]], rows.dropna(subset="reward_weight")
    known = late.assign(goals=late["goals"] / late["actions"])
    parts = {
        "effective sample / buffer": ("effective", ".0%"),
        "goals in the buffer": ("goals", ".2%"),
        "goals in a batch": ("goals_sampled", ".2%"),
        "median TD error": ("td_error", ".2f"),
        "rank correlation with the mirror image": ("mirror", ".2f"),
    }
    cells = [
        [str(name), *(_range(each[column], form) for column, form in parts.values())]
        for name, each in known.groupby("method", sort=False)
    ]
    weights = [
        [str(name), *(_range(at["reward_weight"], ".2f") for _, at in each.groupby("actions"))]
        for name, each in fused.groupby("method", sort=False)
    ]
    head = [
        "weight of the reward after",
        *(f"{n:,} actions" for n in sorted(set(fused["actions"]))),
    ]
    return table(["method", *parts], cells) + "\n\n" + table(head, weights)


def _range(values: pd.Series, form: str) -> str:
    return f"{values.mean():{form}} [{values.min():{form}}, {values.max():{form}}]"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write the rows and show their means."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.study strength",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--methods", nargs="+", default=METHODS, help="(default: all seven)")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="(1700 to 1702)")
    parser.add_argument("--output", type=Path, default=Path("runs/strength"), help="a folder")
    parser.add_argument("--show", type=Path, metavar="CSV", help="show these rows; run nothing")
    options = parser.parse_args(arguments)
    if options.show is None:
        register()
        options.output.mkdir(parents=True, exist_ok=True)
        options.show, found = options.output / "strength.csv", pd.DataFrame()
        if options.show.exists():
            found = pd.read_csv(options.show)
        done = set() if found.empty else set(zip(found["method"], found["seed"], strict=True))
        for seed, method in product(options.seeds, options.methods):
            if (method, seed) not in done:
                rows = pd.DataFrame(map(asdict, rows_of(method, seed)))
                found = pd.concat([found, rows], ignore_index=True)
                found.to_csv(options.show, index=False, float_format="%.4f")
    print(tables_of(pd.read_csv(options.show)))
    return 0
