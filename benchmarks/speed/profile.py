"""Profile where the time goes, as a Markdown table of medians.

    python -m benchmarks.speed.profile step       a training step, 2 x 64 and 2 x 256 units
    python -m benchmarks.speed.profile replay     sample and update, 256 and 16 x 256 of 100,000

MPFA-PER, CPU time of one thread. A step is on an environment that does nothing, eager and compiled.
The rest is what a call takes beside its parts.
"""

from __future__ import annotations

import argparse
import logging
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import wraps
from typing import Any
from unittest.mock import patch

from benchmarks.speed.replay import BATCH_SIZE, make_mpfa_buffer, make_mpfa_update
from benchmarks.speed.timing import MICROSECONDS, Call, few_threads
from benchmarks.speed.training import Agent, IdleTorchEnv, make_loop
from torchrl_mpfa import ActorCritic, SignalReplayBuffer, SignalSampler, SignalTensorStorage
from training.run.assembly import has_compiler

Part = tuple[Any, str]
"""An owner of a function, and the name of the function."""
STEP: dict[str, Part] = {
    "policy and noise": (Agent, "act"),
    "environment": (IdleTorchEnv, "step"),
    "write": (SignalReplayBuffer, "extend"),
    "sample": (SignalReplayBuffer, "sample"),
    "update: losses, signals, backward pass, optimizer, targets": (ActorCritic, "update"),
    "priorities": (SignalReplayBuffer, "update_tensordict_priority"),
}
SAMPLE: dict[str, Part] = {
    "sample": (SignalReplayBuffer, "sample"),
    "– slots, weights, counts and times, Eqs. (8), (10)": (SignalSampler, "sample"),
    "– entries of the batch": (SignalTensorStorage, "batch"),
}
UPDATE: dict[str, Part] = {
    "update": (SignalReplayBuffer, "update_tensordict_priority"),
    "– signals, priorities and leaves, Eqs. (8), (13)-(24)": (SignalSampler, "update_signals"),
}
_FIRST = 20
"""Calls that are not counted: they compile, and fill caches."""


def profile(step: Call, parts: Mapping[str, Part], *, calls: int) -> dict[str, float]:
    """Measure the median CPU time of each part of a step [s]."""
    spent: dict[str, list[float]] = {name: [] for name in parts}

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.thread_time()
            result = function(*args, **kwargs)
            spent[name].append(time.thread_time() - start)
            return result

        return call

    with ExitStack() as stack:
        for name, (owner, method) in parts.items():
            function = timed(name, getattr(owner, method))
            stack.enter_context(patch.object(owner, method, function))
        for _ in range(_FIRST + calls):
            step()
    return {name: statistics.median(times[_FIRST:]) for name, times in spent.items()}


def profile_steps(calls: int) -> list[list[str]]:
    """Return the rows of the table of a training step, the head first."""
    compiled = [False, True] if has_compiler() else [False]
    cases = [(width, compile) for width in (64, 256) for compile in compiled]
    times = [profile(make_loop(width=w, compile=c), STEP, calls=calls) for w, c in cases]
    totals = [sum(of_case.values()) for of_case in times]
    rows = [["", *(f"2 × {width}, {'compiled' if c else 'eager'}" for width, c in cases)]]
    for part in STEP:
        spent = zip(times, totals, strict=True)
        rows.append([part, *(f"{of_case[part] / total:.0%}" for of_case, total in spent)])
    return [*rows, ["all [ms]", *(f"{1e3 * total:.1f}" for total in totals)]]


def profile_replay(calls: int) -> list[list[str]]:
    """Return the rows of the table of replay, the head first."""
    counts = (BATCH_SIZE, 16 * BATCH_SIZE)
    steps = [make_mpfa_update(make_mpfa_buffer(100_000, count), count) for count in counts]
    times = [profile(step, SAMPLE | UPDATE, calls=calls) for step in steps]
    rows = [["[µs]", str(counts[0]), f"16 × {BATCH_SIZE}"]]
    for parts in (SAMPLE, UPDATE):
        whole, *inner = parts
        rest = [of_case[whole] - sum(of_case[part] for part in inner) for of_case in times]
        for part in parts:
            rows.append([part, *(f"{of_case[part] * MICROSECONDS:.0f}" for of_case in times)])
        rows.append(["– rest", *(f"{seconds * MICROSECONDS:.0f}" for seconds in rest)])
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["step", "replay"])
    parser.add_argument("--calls", type=int, default=300, help="to measure (default: 300)")
    options = parser.parse_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    with few_threads(1):
        table = profile_steps if options.what == "step" else profile_replay
        head, *rows = table(options.calls)
    for row in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
