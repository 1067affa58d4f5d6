"""Profile the time of sampling and of new priorities, as a Markdown table.

    python -m benchmarks.speed.replay_profile       256 and 16 x 256 of 100,000 transitions
    python -m benchmarks.speed.replay_profile --capacity 1000000

MPFA-PER by compiled loops, CPU time of one thread; each part is the median over the calls, and
"rest" what a call takes beside its parts.
"""

from __future__ import annotations

import argparse
import logging
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import wraps
from typing import Any
from unittest.mock import patch

from benchmarks.speed.replay import BATCH_SIZE, make_mpfa_buffer, make_mpfa_update
from benchmarks.speed.timing import MICROSECONDS, few_threads
from torchrl_mpfa import SignalReplayBuffer, SignalTensorStorage
from torchrl_mpfa.samplers import fused

Part = tuple[str, Any, str]
SAMPLE: tuple[Part, ...] = (
    ("slots, weights, counts and times, Eqs. (8), (10)", fused, "sample_compiled"),
    ("entries of the batch", SignalTensorStorage, "batch"),
)
UPDATE: tuple[Part, ...] = (
    ("signals, priorities and leaves, Eqs. (8), (13)-(24)", fused, "update_compiled"),
)
CALLS: tuple[tuple[Part, tuple[Part, ...]], ...] = (
    (("sample", SignalReplayBuffer, "sample"), SAMPLE),
    (("update", SignalReplayBuffer, "update_tensordict_priority"), UPDATE),
)


def profile(*, capacity: int, count: int, calls: int) -> dict[str, float]:
    """Measure the median CPU time of each part of sampling and updating [s]."""
    step = make_mpfa_update(make_mpfa_buffer(capacity, count), count)
    for _ in range(20):
        step()
    spent: dict[str, list[float]] = {}

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        times = spent.setdefault(name, [])

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.thread_time()
            found = function(*args, **kwargs)
            times.append(time.thread_time() - start)
            return found

        return call

    with ExitStack() as stack:
        for whole, parts in CALLS:
            for name, owner, method in (whole, *parts):
                function = timed(name, getattr(owner, method))
                stack.enter_context(patch.object(owner, method, function))
        for _ in range(calls):
            step()
    return {name: statistics.median(times) for name, times in spent.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--capacity", type=int, default=100_000, help="slots (default: 100000)")
    parser.add_argument("--calls", type=int, default=2000, help="calls to measure (default: 2000)")
    options = parser.parse_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    counts = (BATCH_SIZE, 16 * BATCH_SIZE)
    with few_threads(1):
        found = [profile(capacity=options.capacity, count=c, calls=options.calls) for c in counts]
    print(f"| [µs] | {counts[0]} | 16 × {BATCH_SIZE} |\n|---|---|---|")
    for (whole, _, _), parts in CALLS:
        names = [name for name, _, _ in parts]
        rest = [times[whole] - sum(times[name] for name in names) for times in found]
        rows = [(name, [times[name] for times in found]) for name in (whole, *names)]
        for name, values in (*rows, ("rest", rest)):
            columns = (f"{value * MICROSECONDS:.0f}" for value in values)
            print(f"| {name if name == whole else '– ' + name} | " + " | ".join(columns) + " |")


if __name__ == "__main__":
    main()
