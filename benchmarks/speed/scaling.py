"""Actions and updates per second of a run, by the number of Ray workers that run its robots.

    python -m benchmarks.speed.scaling --workers 0 1 2 4 --robots 32 --updates 8 --seconds 20

0 workers means a run without Ray; ratios are to the first row. Other settings of
``train.py`` go after ``--``. Time before the first updates is not counted.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from training.run.hooks import Hook
from training.run.loop import TrainingRun
from training.run.script import prepare_process
from training.settings.command_line import composed
from training.settings.train import register

_WARM = 4
"""Iterations with updates that are not counted: programs are compiled, and workers fall in step."""


def measure(overrides: Sequence[str], seconds: float) -> tuple[float, float]:
    """Train for some seconds; return actions and updates a second."""
    (settings,) = composed([*overrides, "tracking=off"])
    prepare_process(settings)
    with tempfile.TemporaryDirectory() as folder:
        looks: list[tuple[float, int, int]] = []

        class Look(Hook):
            def on_iteration(self, run: TrainingRun) -> None:
                if run.updates:
                    looks.append((time.perf_counter(), run.actions, run.updates))
                if len(looks) > _WARM + 1 and looks[-1][0] - looks[_WARM][0] > seconds:
                    run.stop.ask()

        run = TrainingRun(settings, Path(folder), hooks=[Look()])
        run.train()
        run.close()
    first, last = looks[_WARM], looks[-1]
    taken = last[0] - first[0]
    return (last[1] - first[1]) / taken, (last[2] - first[2]) / taken


def main() -> None:
    """Print a row for each number of workers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--workers", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--robots", type=int, default=32)
    parser.add_argument("--updates", type=int, default=8, help="per action of each robot")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("overrides", nargs="*", help="settings of train.py, after --")
    options = parser.parse_args()
    register()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print("workers  actions/s  updates/s  ratio", flush=True)
    rows: list[float] = []
    for workers in options.workers:
        own = [f"ray.workers={workers}", f"robots={options.robots}", f"updates={options.updates}"]
        actions, updates = measure([*own, *options.overrides], options.seconds)
        rows.append(actions)
        ratio = actions / rows[0]
        print(f"{workers:7}  {actions:9.0f}  {updates:9.0f}  {ratio:5.2f}", flush=True)


if __name__ == "__main__":
    main()
