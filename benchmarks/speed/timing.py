"""Compare calls by their CPU time, in turns, on a machine that others use as well.

Times are CPU time of one thread (``time.process_time``), so that other programs count as little as
can be. They still share caches and clock: the calls therefore take turns within each round, and
what is reported as a ratio is the median of the rounds' ratios, not the ratio of two times that
were taken apart.
"""

from __future__ import annotations

import gc
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypedDict

import torch

Call = Callable[[], object]
Clock = Callable[[], float]
MICROSECONDS = 1e6


class Entry(TypedDict):
    """One figure of a benchmark; ``ratio`` is against the entry or part that ``baseline`` names."""

    name: str
    value: float
    unit: str
    ratio: float | None
    baseline: str | None


@dataclass(frozen=True)
class Timing:
    """CPU time of one call in each round [s]."""

    rounds: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median over the rounds [s]."""
        return statistics.median(self.rounds)

    @property
    def minimum(self) -> float:
        """Fastest round [s]."""
        return min(self.rounds)

    def ratio(self, other: Timing) -> float:
        """Median of the rounds' ratios to another call that took turns with this one."""
        return statistics.median(a / b for a, b in zip(self.rounds, other.rounds, strict=True))


@contextmanager
def few_threads(count: int) -> Iterator[None]:
    """Let PyTorch use so many threads, and no garbage be collected, for as long as this is open."""
    threads, collects = torch.get_num_threads(), gc.isenabled()
    torch.set_num_threads(count)
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        if collects:
            gc.enable()


def seconds_per_call(call: Call, count: int, *, clock: Clock = time.process_time) -> float:
    """Time of one call, as the mean of ``count`` in a row [s]; CPU time by default."""
    start = clock()
    for _ in range(count):
        call()
    return (clock() - start) / count


def take_turns(
    calls: Mapping[str, Call],
    *,
    rounds: int,
    seconds: float,
    threads: int = 1,
    clock: Clock = time.process_time,
    multiple_of: int = 1,
) -> dict[str, Timing]:
    """Time calls in turns, A B, B A, A B and so on; return as many times of each as rounds.

    A call is repeated in blocks of ``multiple_of`` for some seconds of each round.
    """
    with few_threads(threads):
        counts = {
            name: _repetitions(call, seconds, clock=clock, multiple_of=multiple_of)
            for name, call in calls.items()
        }
        times: dict[str, list[float]] = {name: [] for name in calls}
        for number in range(rounds):
            names = list(calls) if number % 2 == 0 else list(calls)[::-1]
            for name in names:
                times[name].append(seconds_per_call(calls[name], counts[name], clock=clock))
    timings = {name: Timing(tuple(found)) for name, found in times.items()}
    for name, timing in timings.items():
        report_progress(
            f"{name}: {timing.median * MICROSECONDS:.1f} us "
            f"(fastest round {timing.minimum * MICROSECONDS:.1f}, "
            f"{rounds} rounds of {counts[name]} calls)"
        )
    return timings


def _repetitions(call: Call, seconds: float, *, clock: Clock, multiple_of: int) -> int:
    """Return how often a call fits in the time; also warms it up."""
    # The first calls make caches, and would seem slow for good.
    seconds_per_call(call, -(-10 // multiple_of) * multiple_of)
    count = multiple_of
    per_call = seconds_per_call(call, count, clock=clock)
    while per_call * count < seconds / 4:
        count *= 2
        per_call = seconds_per_call(call, count, clock=clock)
    return max(1, round(seconds / max(per_call, 1e-9) / multiple_of)) * multiple_of


def compare(name: str, ours: Call, stock: Call, *, quick: bool) -> list[Entry]:
    """Time a call of this package, which has the ratio, and TorchRL's, ``NAME_torchrl``."""
    baseline = f"{name}_torchrl"
    timings = take_turns(
        {name: ours, baseline: stock},
        rounds=5 if quick else 21,
        seconds=0.03 if quick else 0.1,
    )
    mine, theirs = timings[name], timings[baseline]
    return [
        entry(baseline, theirs.median * MICROSECONDS, "us"),
        entry(name, mine.median * MICROSECONDS, "us", ratio=mine.ratio(theirs), baseline=baseline),
    ]


def entry(
    name: str, value: float, unit: str, *, ratio: float | None = None, baseline: str | None = None
) -> Entry:
    """One figure of a benchmark."""
    return {"name": name, "value": value, "unit": unit, "ratio": ratio, "baseline": baseline}


def report_progress(text: str) -> None:
    """Say on the error stream what was measured, as the table comes last."""
    print(f"  {text}", file=sys.stderr, flush=True)
