"""The runs of a comparison: trained, then evaluated, and gone on with where one is lost."""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from tqdm import tqdm

from training import files
from training.comparison.jobs import Comparison, Evaluation, Job, collect, other_than_asked
from training.comparison.workers import LocalWorker, Lost, Worker
from training.stopping import Stop

JOBS = 2
"""Runs at a time on one machine."""
_PAUSE = 0.3
"""Between two looks at the runs [s]."""
MOST_LOSSES = 10
"""Workers that may be lost under a run, which may be what takes them down."""


def add_options(parser: argparse.ArgumentParser, *, folder: str, what: str) -> None:
    """Where a script makes its runs or trials, and how many at a time."""
    parser.add_argument("--folder", type=Path, default=Path(folder), help=f"(default: {folder})")
    parser.add_argument(
        "--jobs",
        type=int,
        help=f"{what} at a time (default: {JOBS}; with --ray as many as fit)",
    )
    parser.add_argument(
        "--ray",
        nargs="?",
        const="",
        metavar="ADDRESS",
        help="run on a Ray cluster (default: that of RAY_ADDRESS, or of this machine)",
    )


class Running:
    """A run on its way: trained first, then evaluated, with a line on the screen.

    Args:
        job: The run.
        commands: What trains it, unless that is done, and what evaluates it.
        worker: What runs the commands.
        position: Its line.
    """

    def __init__(
        self, job: Job, commands: list[list[str]], *, worker: Worker, position: int
    ) -> None:
        self.job, self.worker, self._commands = job, worker, commands
        job.path.mkdir(parents=True, exist_ok=True)
        self.log = job.path / "output.log"
        self.bar = tqdm(desc=job.name, unit="episode", position=position, leave=False)
        self._start()

    def _start(self) -> None:
        """Have the next command begin."""
        command = self._commands.pop(0)
        self._evaluates = command[0].endswith("evaluate.py")
        self.worker.start(command, self.log)

    def ended(self) -> int | None:
        """Exit status of the last command, or of one that failed; None while it runs."""
        status = self.job.status()
        self.bar.total, self.bar.n = status.get("total"), status.get("done", 0)
        self.bar.unit = status.get("unit", "it")
        self.bar.set_postfix_str("evaluation" if self._evaluates else status.get("summary", ""))
        exit_status = self.worker.ended()
        if exit_status == 0 and self._commands:
            self._start()
            return None
        return exit_status


class Work(Protocol):
    """Runs that workers make: true while there is something to do."""

    def __bool__(self) -> bool: ...

    def begin(self) -> None:
        """Have the workers that have nothing to do begin the next ones, or end."""
        ...

    def look(self) -> None:
        """Take note of those that have ended."""
        ...

    def stop(self) -> None:
        """Have all of them save and end."""
        ...


class Runs:
    """The runs of a comparison that are not done, some of them on their way at a time.

    Args:
        waiting: The runs.
        overrides: Settings of all of them.
        wanted: What their policies shall do.
        anew: Runs to train again from the start.
        workers: What makes them, each one run after another.
    """

    def __init__(
        self,
        waiting: list[Job],
        overrides: Sequence[str],
        wanted: Evaluation,
        *,
        anew: set[Job],
        workers: Sequence[Worker],
    ) -> None:
        self.waiting, self.overrides, self.wanted = waiting, overrides, wanted
        self.anew, self.workers = anew, workers
        self.running: dict[int, Running] = {}
        """By the number of their worker."""
        self.failed: list[Job] = []
        self._losses: Counter[Job] = Counter()
        # The average of the runs that are done tells how long the others will take.
        self._bar = tqdm(desc="runs", total=len(waiting), unit="run", smoothing=0, leave=False)

    def __bool__(self) -> bool:
        return bool(self.waiting or self.running)

    def begin(self) -> None:
        """Have the workers that have nothing to do begin the next ones, or end."""
        for number, worker in enumerate(self.workers):
            if number in self.running:
                continue
            if not self.waiting:
                worker.stop()
                worker.wait()
            elif worker.ready():
                job = self.waiting.pop(0)
                anew = job in self.anew
                trained = job.is_trained() and not anew
                commands = [] if trained else [job.trains(self.overrides, anew=anew)]
                commands.append(job.evaluates(self.wanted))
                self.running[number] = Running(job, commands, worker=worker, position=number + 1)

    def look(self) -> None:
        """Take note of those that have ended."""
        for number, each in list(self.running.items()):
            job = each.job
            try:
                status = each.ended()
            except Lost as error:
                self._lost(job, error)
            else:
                if status is None:
                    continue
                if status == 0:
                    tqdm.write(f"{job.name}: trained and evaluated")
                else:
                    self._fail(job, f"see {each.log}")
            self._bar.update(job not in self.waiting)
            each.bar.close()
            del self.running[number]

    def _fail(self, job: Job, why: str) -> None:
        self.failed.append(job)
        tqdm.write(f"{job.name}: failed, {why}")

    def _lost(self, job: Job, error: Lost) -> None:
        """Have a run go on elsewhere."""
        self._losses[job] += 1
        if self._losses[job] > MOST_LOSSES:
            self._fail(job, f"lost {MOST_LOSSES} workers: {error}")
            return
        tqdm.write(f"{job.name}: its worker is gone, goes on at its last checkpoint: {error}")
        # Once it has begun anew, it has the settings that are asked for.
        if job in self.anew and not other_than_asked([job], self.overrides):
            self.anew.discard(job)
        self.waiting.insert(0, job)

    def stop(self) -> None:
        """Have all of them save and end."""
        for worker in self.workers:
            worker.stop()
        for worker in self.workers:
            worker.wait()
        for bar in (*(each.bar for each in self.running.values()), self._bar):
            bar.close()


def make_runs(
    comparison: Comparison, *, most: int | None = None, ray: str | None = None, anew: bool = False
) -> int:
    """Train what is not trained, evaluate it, collect the rows.

    Args:
        comparison: The runs.
        most: How many at a time; None: :data:`JOBS`, or on a cluster as many as there are.
        ray: Address of a Ray cluster, empty for the one that there is; None: on this machine.
        anew: Whether runs with other settings are trained again.

    Returns:
        Exit status: 1 if a run failed, 128 and the number of the signal that stopped it.

    Raises:
        ValueError: If a run was trained with other settings, or Ray cannot be used.
        FolderInUse: If another process makes runs there.
    """
    jobs, wanted = comparison.jobs, comparison.evaluation
    with files.lock(comparison.folder):
        others = other_than_asked(jobs, comparison.settings)
        if others and not anew:
            job, found = next(iter(others.items()))
            raise ValueError(
                f"{job.path} was trained with {'; '.join(found)}: name another --folder, or "
                "train it again with --anew"
            )
        waiting = [job for job in jobs if job in others or not job.is_evaluated(wanted)]
        print(f"{len(jobs)} runs, {len(jobs) - len(waiting)} of them done, in {comparison.folder}")
        most = min(most or (JOBS if ray is None else len(waiting)), len(waiting))
        with workers_of(ray if waiting else None, most) as workers:
            runs = Runs(waiting, comparison.settings, wanted, anew=set(others), workers=workers)
            stop = run_all(runs)
        if stop:
            return stop.exit_status
        collect(jobs, wanted, comparison.folder)
    return 1 if runs.failed else 0


@contextmanager
def workers_of(address: str | None, count: int) -> Iterator[list[Worker]]:
    """Workers on this machine, or on a cluster."""
    if address is None:
        yield [LocalWorker() for _ in range(count)]
        return
    try:
        from training.comparison.clusters import RemoteWorker, connected
    except ImportError as error:
        raise ValueError("--ray needs Ray: pip install 'torchrl-mpfa[ray]'") from error
    try:
        with connected(address or None):
            yield [RemoteWorker() for _ in range(count)]
    except ConnectionError as error:
        raise ValueError(f"--ray {address}: {error}") from error


def run_all(runs: Work) -> Stop:
    """Do all of it, some runs at a time; whether it was stopped."""
    stop = Stop("saving the runs; the same command continues them")
    with stop.listening():
        try:
            while runs and not stop:
                runs.begin()
                time.sleep(_PAUSE)
                runs.look()
        finally:
            runs.stop()
    return stop
