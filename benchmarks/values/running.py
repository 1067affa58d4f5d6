"""Many trainings on frozen buffers: one after another, or by several processes."""

from __future__ import annotations

import logging
import multiprocessing
import warnings
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import partial
from itertools import product
from pathlib import Path

import pandas as pd
import torch
from tqdm import tqdm

from benchmarks.values.arms import AGAINST, ARMS
from benchmarks.values.frozen import FrozenBuffer, frozen_buffers
from benchmarks.values.learning import Measure, ReplayFunction, SignalFunction, learn
from benchmarks.values.report import differences
from torchrl_mpfa.methods import Method
from torchrl_mpfa.saving import write_text_atomically

_RUN = ["buffer", "method", "seed"]
_DIGITS = 5


def compare(
    methods: Sequence[str | Method | ReplayFunction],
    buffers: Sequence[FrozenBuffer],
    *,
    seeds: Iterable[int] = range(6),
    signals: Mapping[str, SignalFunction] | None = None,
    against: str = AGAINST,
) -> pd.DataFrame:
    """Train each method on each buffer with each seed, and report their differences to one of them.

    Args:
        methods: As for :func:`~benchmarks.values.learn`.
        buffers: As :func:`~benchmarks.values.frozen_buffers` gives them.
        seeds: Of the trainings.
        signals: Functions of your own that write the signals of a method.
        against: Name of the method that the others are compared with; one of ``methods``.

    Returns:
        A row for each of the others, see :func:`~benchmarks.values.report.differences`.

    Raises:
        ValueError: If ``against`` is not among the methods.
    """
    _quiet()
    names = [_name(method) for method in methods]
    if against not in names:
        raise ValueError(f"against must be one of the methods, {', '.join(names)}, got {against!r}")
    runs = list(product(seeds, buffers, methods))
    found: list[Measure] = []
    for seed, buffer, method in tqdm(runs, unit="run"):
        found += learn(buffer, method, seed, signals=signals)
    return differences(pd.DataFrame(map(asdict, found)), against=against)


def read_rows(path: Path) -> pd.DataFrame:
    """The rows of trainings that were made; none if there is no such file."""
    if not path.exists():
        return pd.DataFrame(columns=list(Measure.__dataclass_fields__))
    return pd.read_csv(path)


def make_rows(
    path: Path, arms: Sequence[str], seeds: Sequence[int], *, jobs: int, folder: Path
) -> None:
    """Add the trainings of table G that are missing in a file of rows, in some processes.

    Seeds are outside: a table that is cut short has as many of each arm.
    """
    rows = read_rows(path)
    made = set(rows[_RUN].itertuples(index=False, name=None))
    buffers = sorted(each.stem for each in folder.glob("*.npz"))
    left = [
        (arm, seed, missing)
        for seed, arm in product(seeds, arms)
        if (missing := [name for name in buffers if (name, arm, seed) not in made])
    ]
    spawn = multiprocessing.get_context("spawn")
    total = sum(len(missing) for *_, missing in left)
    with (
        ProcessPoolExecutor(jobs, mp_context=spawn, initializer=_one_thread) as pool,
        tqdm(total=total, unit="run") as bar,
    ):
        tasks = {pool.submit(_train, folder, *each): len(each[-1]) for each in left}
        for task in as_completed(tasks):
            found = pd.DataFrame(task.result())
            rows = found if rows.empty else pd.concat([rows, found], ignore_index=True)
            ordered = rows.sort_values([*_RUN, "updates"], kind="stable")
            text = ordered.to_csv(index=False, float_format=f"%.{_DIGITS}g", lineterminator="\n")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text_atomically(text, path)
            bar.update(tasks[task])


def _train(folder: Path, arm: str, seed: int, names: list[str]) -> list[dict[str, object]]:
    """Rows of one arm and seed on some buffers, in a process of their own."""
    wanted = {each.name: each for each in _buffers(folder)}
    made = ARMS[arm]
    train = partial(
        learn,
        signals=made.signals,
        mirrored=made.mirrored,
        compile=True,
    )
    found = (train(wanted[name], made.method, seed) for name in names)
    return [asdict(measure) for each in found for measure in each]


_READ: dict[Path, list[FrozenBuffer]] = {}
"""Buffers that a process has read."""


def _buffers(folder: Path) -> list[FrozenBuffer]:
    if folder not in _READ:
        _READ[folder] = frozen_buffers(folder)
    return _READ[folder]


def _quiet() -> None:
    """Silence TorchRL's message about each new storage."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)


def _one_thread() -> None:
    _quiet()
    torch.set_num_threads(1)
    # Of readings of the paper that are compared here.
    warnings.filterwarnings("ignore", message="positive_above='mean'")


def _name(method: str | Method | ReplayFunction) -> str:
    return method if isinstance(method, str) else getattr(method, "name", "")
