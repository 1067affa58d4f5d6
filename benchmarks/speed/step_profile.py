"""Profile the time of a training step, as a Markdown table.

    python -m benchmarks.speed.step_profile       2 x 64 and 2 x 256 units, eager and compiled
    python -m benchmarks.speed.step_profile --widths 128

MPFA-PER on an environment that does nothing. CPU time of one thread; each part is the median over
the steps.
"""

from __future__ import annotations

import argparse
import logging
import statistics
import time
from collections import defaultdict
from collections.abc import Sequence

from torchrl.envs.utils import step_mdp

from benchmarks.speed.timing import MICROSECONDS, few_threads
from benchmarks.speed.training import TRANSITION, Agent, IdleTorchEnv
from training.run.assembly import has_compiler

PARTS = ("policy and noise", "environment", "write", "sample", "update", "priorities")


def profile(*, width: int, compile: bool, steps: int) -> dict[str, float]:
    """Measure the median CPU time of each part of a step [s]."""
    agent, env = Agent(plain=True, width=width, compile=compile), IdleTorchEnv()
    state = env.reset()
    spent: dict[str, list[float]] = defaultdict(list)
    for number in range(steps + 20):
        times = [time.process_time()]
        agent.act(state)
        times.append(time.process_time())
        state = env.step(state)
        transition = state.select(*TRANSITION).unsqueeze(0)
        state = step_mdp(state)
        times.append(time.process_time())
        agent.buffer.extend(transition)
        times.append(time.process_time())
        batch = agent.buffer.sample()
        times.append(time.process_time())
        agent.learner.update(batch)
        times.append(time.process_time())
        agent.buffer.update_tensordict_priority(batch)
        times.append(time.process_time())
        if number >= 20:  # The first ones compile, and fill caches.
            for part, before, after in zip(PARTS, times, times[1:], strict=False):
                spent[part].append(after - before)
    return {part: statistics.median(values) for part, values in spent.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--widths", nargs="+", type=int, default=[64, 256], help="units per layer")
    parser.add_argument("--steps", type=int, default=300, help="steps to measure (default: 300)")
    options = parser.parse_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    ways = [False, True] if has_compiler() else [False]
    cases = [(width, way) for width in options.widths for way in ways]
    with few_threads(1):
        found = [profile(width=w, compile=way, steps=options.steps) for w, way in cases]
    print("| | " + " | ".join(f"2 × {w}, {'compiled' if c else 'eager'}" for w, c in cases) + " |")
    print("|---" * (len(cases) + 1) + "|")
    for part in PARTS:
        shares = (f"{times[part] / sum(times.values()):.0%}" for times in found)
        print(f"| {part} | " + " | ".join(shares) + " |")
    totals = (f"{sum(times.values()) * MICROSECONDS / 1000:.1f}" for times in found)
    print("| all [ms] | " + " | ".join(totals) + " |")


if __name__ == "__main__":
    main()
