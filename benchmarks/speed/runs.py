"""A short training run with its evaluation: the first of a process, and one after others.

The difference is what a process takes to start: to import, load and compile what all runs use.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.speed.timing import Entry, entry
from training.comparison.jobs import Evaluation, Job
from training.comparison.workers import LocalWorker

SETTINGS = (
    *("regime=rooms", "learner.compile=true", "tracking=off"),
    *("evaluation.every=0", "evaluation.choose=false"),
    "actions=1600",
)
_WANTED = Evaluation(("test",), 4)
_PAUSE = 0.01
"""Between two looks at a run [s]."""


def measure(*, quick: bool, settings: Sequence[str] = SETTINGS) -> list[Entry]:
    """Make runs in one process: ``run_alone``, and ``run_of_several``, the median of the rest."""
    with TemporaryDirectory() as folder:
        worker = LocalWorker()
        jobs = [Job("td3", "mpfa_per", seed, Path(folder)) for seed in range(3 if quick else 6)]
        try:
            alone, *others = (_seconds(worker, job, settings) for job in jobs)
        finally:
            worker.stop()
            worker.wait()
    several = statistics.median(others)
    return [entry("run_alone", alone, "s"), entry("run_of_several", several, "s")]


def _seconds(worker: LocalWorker, job: Job, settings: Sequence[str]) -> float:
    start, log = time.perf_counter(), job.path / "output.log"
    job.path.mkdir()
    for command in (job.trains(settings), job.evaluates(_WANTED)):
        worker.start(command, log)
        while (status := worker.ended()) is None:
            time.sleep(_PAUSE)
        if status:
            raise RuntimeError(f"{command} failed: {log.read_text(encoding='utf-8')}")
    return time.perf_counter() - start
