"""Show that priorities work: updates to convergence on the blind cliffwalk of the PER paper.

    python -m benchmarks.study cliffwalk    2 to 12 states, ten seeds, two minutes
    python -m benchmarks.study cliffwalk --lengths 4,8,16 --seeds 3    other lengths
    python -m benchmarks.study cliffwalk --eps 0.05    with MPFA-PER's constant

Writes ``cliffwalk.csv``, one row per run, and ``cliffwalk.png``, the medians over the seeds.
``docs/cliffwalk.md`` explains the measure and the results.
"""

from __future__ import annotations

import argparse
import csv
import logging
import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tqdm import tqdm

from mpfa_envs.render.charts import finish, new_figure
from torchrl_mpfa.cliffwalk import (
    Cliffwalk,
    CliffwalkValues,
    Features,
    Transition,
    updates_to_convergence,
)
from torchrl_mpfa.methods import make_replay
from training.files import check_folder

ORACLE = "greedy oracle"
# A table has no action gradient, so that MPFA-PER fuses its other two signals.
ARMS: dict[str, dict[str, Any]] = {
    "uniform": {"method": "uniform"},
    "rank-based PER": {"method": "rank_per"},
    "proportional PER": {"method": "per"},
    "MPFA-PER": {"method": "mpfa_per", "signals": ["reward", "td_error"]},
    ORACLE: {},
}
COLORS = ("0.45", "#0072b2", "#56b4e9", "#d55e00", "black")
EPS = 1e-4
"""Of all methods. Rewards are one at most here, and most TD errors a tenth of that."""
_UNIFORM_BATCH = 256
_BATCHES = 512


@dataclass(frozen=True)
class Row:
    """A run: how many updates it took."""

    features: str
    eps: float
    length: int
    transitions: int
    replay: str
    seed: int
    updates: float


def batch_size_of(cliff: Cliffwalk) -> int:
    """A 512th of the memory: priorities are at most so old, and long cliffs take minutes at most.

    Examples:
        >>> [batch_size_of(Cliffwalk(length)) for length in (2, 8, 12, 16)]
        [1, 1, 15, 255]
    """
    return max(1, cliff.size // _BATCHES)


def oracle_updates(
    cliff: Cliffwalk,
    *,
    features: Features = "tabular",
    threshold: float = 1e-3,
    limit: int = 10_000,
    seed: int = 0,
) -> float:
    """Updates until Q is the true one, if each is the one after which its error is the least.

    No replay can know that; it is the paper's bound of what prioritization may gain.

    Examples:
        >>> oracle_updates(Cliffwalk(6)) < 250
        True
    """
    generator = torch.Generator().manual_seed(seed)
    kinds = _kinds(cliff.transitions(generator))
    values = CliffwalkValues(cliff, features=features, generator=generator)
    for updates in range(1, limit + 1):
        values.learn(*min(kinds, key=values.error_after))
        if values.error < threshold:
            return updates
    return math.inf


def _kinds(transitions: TensorDict) -> Sequence[Transition]:
    """The different transitions."""
    after = transitions["next"]
    columns = [transitions["state"], transitions["action"], after["state"]]
    return sorted(
        set(
            zip(
                *(column.tolist() for column in columns),
                after["reward"].squeeze(1).tolist(),
                after["terminated"].squeeze(1).tolist(),
                strict=True,
            )
        )
    )


def run_one(arm: str, cliff: Cliffwalk, *, features: Features, eps: float, seed: int) -> float:
    """Count the updates of a run."""
    if arm == ORACLE:
        return oracle_updates(cliff, features=features, seed=seed)
    settings = dict(ARMS[arm])
    # Without priorities it makes no difference how many are sampled at once.
    batch_size = _UNIFORM_BATCH if arm == "uniform" else batch_size_of(cliff)
    replay = make_replay(
        settings.pop("method"),
        capacity=cliff.size,
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(seed),
        eps=eps,
        **settings,
    )
    return updates_to_convergence(cliff, replay.buffer, features=features, seed=seed)


def run_all(lengths: Sequence[int], *, seeds: int, features: Features, eps: float) -> Iterator[Row]:
    """Count the updates of every run, the shortest cliffs first."""
    for length in lengths:
        cliff = Cliffwalk(length)
        for arm in ARMS:
            for seed in range(seeds):
                updates = run_one(arm, cliff, features=features, eps=eps, seed=seed)
                yield Row(features, eps, length, cliff.size, arm, seed, updates)


def medians(rows: Sequence[Row]) -> dict[str, dict[int, float]]:
    """Median updates by replay and length."""
    counts: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        counts.setdefault(row.replay, {}).setdefault(row.length, []).append(row.updates)
    return {
        replay: {length: statistics.median(of) for length, of in each.items()}
        for replay, each in counts.items()
    }


def write_rows(rows: Sequence[Row], path: Path) -> None:
    """Write a table of runs."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(map(asdict, rows))


def plot(rows: Sequence[Row], path: Path) -> None:
    """Plot the medians over the length of the cliff, and the least and most of the seeds."""
    figure, (axes,) = new_figure(panel=(6.4, 4.2))
    for (arm, by_length), color in zip(medians(rows).items(), COLORS, strict=True):
        lengths = list(by_length)
        spread = [
            [r.updates for r in rows if (r.replay, r.length) == (arm, length)] for length in lengths
        ]
        axes.plot(lengths, list(by_length.values()), "o-", ms=4, color=color, label=arm)
        low, high = [min(of) for of in spread], [max(of) for of in spread]
        axes.fill_between(lengths, low, high, color=color, alpha=0.15, lw=0)
    sizes = {row.length: row.transitions for row in rows}
    axes.plot(list(sizes), list(sizes.values()), ":", color="0.6", label="transitions in memory")
    axes.set(
        yscale="log",
        xlabel="states of the cliff",
        ylabel="updates to convergence",
        xticks=list(sizes),
        title=f"Blind cliffwalk, {rows[0].features} Q",
    )
    axes.legend(fontsize=8)
    finish(figure, [axes], path, dpi=110)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for, and write table and figure."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.study cliffwalk",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--lengths", default="2,4,6,8,10,12", help="numbers of states, 2 to 20")
    parser.add_argument("--seeds", type=int, default=10, help="runs of each")
    parser.add_argument("--features", choices=("tabular", "linear"), default="tabular")
    parser.add_argument("--eps", type=float, default=EPS, help="added to every priority")
    parser.add_argument("--output", type=Path, default=Path("runs/cliffwalk"), help="folder")
    options = parser.parse_args(arguments)
    try:
        lengths = sorted({int(word) for word in options.lengths.split(",")})
        for length in lengths:
            Cliffwalk(length)
    except ValueError as error:
        parser.error(f"--lengths: {error}")
    if options.seeds < 1:
        parser.error(f"--seeds must be at least 1, got {options.seeds}")
    if not 0 < options.eps < math.inf:
        parser.error(f"--eps must be positive and finite, got {options.eps}")
    try:
        check_folder(options.output)
    except ValueError as error:
        parser.error(f"--output: {error}")
    torch.set_num_threads(1)
    # TorchRL announces each storage in the middle of the progress bar.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    runs = run_all(lengths, seeds=options.seeds, features=options.features, eps=options.eps)
    rows = []
    with tqdm(total=len(lengths) * options.seeds * len(ARMS), unit="run") as bar:
        for row in runs:
            rows.append(row)
            bar.set_postfix_str(f"{row.length} states, {row.replay}")
            bar.update()
    options.output.mkdir(parents=True, exist_ok=True)
    write_rows(rows, options.output / "cliffwalk.csv")
    plot(rows, options.output / "cliffwalk.png")
    print(f"{'median updates':18}" + "".join(f"{length:>10}" for length in lengths))
    for arm, by_length in medians(rows).items():
        print(f"{arm:18}" + "".join(f"{updates:>10.0f}" for updates in by_length.values()))
    return 0
