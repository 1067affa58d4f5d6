"""What a process takes to start: to import the package, print the help, and make its first run."""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.speed.timing import Entry, entry, report_progress
from training.comparison.jobs import Evaluation, Job
from training.comparison.workers import LocalWorker

_TRAIN = Path(__file__).parents[2] / "examples" / "train.py"
COMMANDS: dict[str, list[str]] = {
    "import_torchrl": ["-c", "import torch, torchrl, tensordict"],
    "import_package": ["-c", "import torch, torchrl, tensordict, torchrl_mpfa"],
    "import_buffer": ["-c", "from torchrl_mpfa import SignalReplayBuffer"],
    "train_help": [str(_TRAIN), "--help"],
}
"""Arguments of Python; the first is what the others are compared with."""


def measure(*, quick: bool) -> list[Entry]:
    """Run each command some times in turn; medians have ratios to the first command."""
    found: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for _ in range(1 if quick else 5):
        for name, arguments in COMMANDS.items():
            found[name].append(_seconds(arguments))
    times = {name: statistics.median(each) for name, each in found.items()}
    base, *others = times
    entries = [entry(base, times[base], "s")]
    for name in others:
        ratio = times[name] / times[base]
        report_progress(f"{name}: {times[name]:.2f} s of CPU time, {ratio:.2f} of {base}")
        entries.append(entry(name, times[name], "s", ratio=ratio, baseline=base))
    return entries


def _seconds(arguments: Sequence[str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


RUN = (
    *("regime=rooms", "learner.compile=true", "tracking=off"),
    *("evaluation.every=0", "evaluation.choose=false"),
    "actions=1600",
)
"""A short training run."""
_WANTED = Evaluation(("test",), 4)
_PAUSE = 0.01
"""Between two looks at a run [s]."""


def measure_runs(*, quick: bool, settings: Sequence[str] = RUN) -> list[Entry]:
    """Make runs in one process: ``run_alone``, and ``run_of_several``, the median of the rest.

    The difference is what a process takes to import, load and compile what all runs use.
    """
    with TemporaryDirectory() as folder:
        worker = LocalWorker()
        jobs = [Job("td3", "mpfa_per", seed, Path(folder)) for seed in range(3 if quick else 6)]
        try:
            alone, *others = (_seconds_of_run(worker, job, settings) for job in jobs)
        finally:
            worker.stop()
            worker.wait()
    several = statistics.median(others)
    return [entry("run_alone", alone, "s"), entry("run_of_several", several, "s")]


def _seconds_of_run(worker: LocalWorker, job: Job, settings: Sequence[str]) -> float:
    start, log = time.perf_counter(), job.path / "output.log"
    job.path.mkdir()
    for command in (job.trains(settings), job.evaluates(_WANTED)):
        worker.start(command, log)
        while (status := worker.ended()) is None:
            time.sleep(_PAUSE)
        if status:
            raise RuntimeError(f"{command} failed: {log.read_text(encoding='utf-8')}")
    return time.perf_counter() - start
