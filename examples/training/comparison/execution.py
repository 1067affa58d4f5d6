"""Work for workers: runs that are trained and evaluated, and resumed where a worker is lost."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

from tqdm import tqdm

from torchrl_mpfa import Stop
from training import files
from training.comparison.jobs import Comparison, Evaluation, Job, collect, other_than_asked
from training.comparison.workers import LocalWorker, Lost, Worker
from training.inherited import forget_single_run
from training.options import JOBS

LOG = "output.log"
"""Output of the scripts, in the folder of a run."""
_PAUSE = 0.3
"""Between two looks at the runs [s]."""
MOST_LOSSES = 10
"""Workers that may be lost under a run, which may be the cause itself."""
Item = TypeVar("Item")
Commands = list[list[str]]


class Running:
    """A run in progress: its commands one after another, with a line on the screen."""

    def __init__(self, job: Job, commands: Commands, *, worker: Worker, position: int) -> None:
        self.job, self.worker, self._commands = job, worker, commands
        job.path.mkdir(parents=True, exist_ok=True)
        self.log = job.path / LOG
        self.bar = tqdm(desc=job.name, unit="episode", position=position, leave=False, disable=None)
        self._start()

    def _start(self) -> None:
        """Start the next command."""
        command = self._commands.pop(0)
        self._evaluates = command[0].endswith("evaluate.py")
        self.worker.start(command, self.log)

    def ended(self) -> int | None:
        """Return the exit status of the last command, or of a failed one; None while it runs."""
        status = self.job.status()
        self.bar.total, self.bar.n = status.get("total"), status.get("done", 0)
        self.bar.unit = status.get("unit", "it")
        self.bar.set_postfix_str("evaluation" if self._evaluates else status.get("summary", ""))
        exit_status = self.worker.ended()
        if exit_status == 0 and self._commands:
            self._start()
            return None
        return exit_status


class Work(ABC, Generic[Item]):
    """Items that workers make by runs, each worker one run after another."""

    def __init__(self, waiting: list[Item], workers: Sequence[Worker], bar: tqdm[Any]) -> None:
        self.waiting, self.workers, self.bar = waiting, workers, bar
        self.running: dict[int, tuple[Item, Running]] = {}
        """Item and run by the number of the worker."""
        self._losses: Counter[str] = Counter()

    @property
    def has_more(self) -> bool:
        """True if there is an item to begin or to resume."""
        return bool(self.waiting)

    @abstractmethod
    def take(self) -> tuple[Item, Job, Commands] | None:
        """Return the next item, its run and its commands; None if there is none."""

    @abstractmethod
    def end(self, item: Item, status: int | None) -> None:
        """End an item, or its present run; the status is None if it was given up."""

    @abstractmethod
    def fail(self, item: Item, why: str) -> None:
        """End an item without a result."""

    def name_of(self, item: Item) -> str:
        """Return the name of an item."""
        return str(item)

    def is_hopeless(self, item: Item) -> bool:
        """Return True if an item in progress is to be given up."""
        return False

    def begin(self) -> None:
        """Start the next runs on idle workers; release workers that are no longer needed."""
        for number, worker in enumerate(self.workers):
            if number in self.running or (self.has_more and not worker.ready()):
                continue
            taken = self.take()
            if taken is None:
                worker.stop()
                worker.wait()
            else:
                item, job, commands = taken
                run = Running(job, commands, worker=worker, position=number + 1)
                run.bar.set_description(self.name_of(item))
                self.running[number] = item, run

    def look(self) -> None:
        """End or resume the items whose runs have ended, were lost, or are hopeless."""
        for number, (item, run) in list(self.running.items()):
            try:
                status = run.ended()
            except Lost as error:
                self._lost(item, error)
            else:
                hopeless = self.is_hopeless(item)
                if status is None and not hopeless:
                    continue
                if status is None:
                    run.worker.stop()
                    run.worker.wait()
                self.end(item, None if hopeless else status)
            run.bar.close()
            del self.running[number]

    def _lost(self, item: Item, error: Lost) -> None:
        """Let a run resume on another worker."""
        name = self.name_of(item)
        self._losses[name] += 1
        if self._losses[name] > MOST_LOSSES:
            self.fail(item, f"lost {MOST_LOSSES} workers: {error}")
            return
        tqdm.write(f"{name}: its worker is gone, resumes at its last checkpoint: {error}")
        self.waiting.insert(0, item)

    def run(self) -> Stop:
        """Make all items, some at a time; return how that was stopped."""
        forget_single_run()
        stop = Stop("saving the runs; the same command continues them", write=tqdm.write)
        with stop.listening():
            try:
                while (self.has_more or self.running) and not stop:
                    self.begin()
                    time.sleep(_PAUSE)
                    self.look()
            finally:
                for worker in self.workers:
                    worker.stop()
                for worker in self.workers:
                    worker.wait()
                for bar in (*(run.bar for _, run in self.running.values()), self.bar):
                    bar.close()
        return stop


class Runs(Work[Job]):
    """The runs of a comparison that are not done; runs ``anew`` are trained from the start."""

    def __init__(
        self,
        waiting: list[Job],
        overrides: Sequence[str],
        wanted: Evaluation,
        *,
        anew: set[Job],
        workers: Sequence[Worker],
    ) -> None:
        # The average of the runs that are done shows how long the others will take.
        bar = tqdm(
            desc="runs", total=len(waiting), unit="run", smoothing=0, leave=False, disable=None
        )
        super().__init__(waiting, workers, bar)
        self.overrides, self.wanted, self.anew = overrides, wanted, anew
        self.failed: list[Job] = []

    def name_of(self, item: Job) -> str:
        """Return the name of a run."""
        return item.name

    def take(self) -> tuple[Job, Job, Commands] | None:
        """Return the next run, and the commands that are left of it."""
        if not self.waiting:
            return None
        job = self.waiting.pop(0)
        # After a lost worker, a run that has begun again has the settings that are asked for.
        anew = job in self.anew and bool(other_than_asked([job], self.overrides))
        commands = [job.evaluates(self.wanted)]
        if anew or not job.is_trained():
            commands.insert(0, job.trains(self.overrides, anew=anew))
        return job, job, commands

    def end(self, item: Job, status: int | None) -> None:
        """Report the end of a run."""
        if status:
            self.fail(item, f"see {item.path / LOG}")
        else:
            self.bar.update()
            tqdm.write(f"{item.name}: trained and evaluated")

    def fail(self, item: Job, why: str) -> None:
        """Report a run that failed."""
        self.bar.update()
        self.failed.append(item)
        tqdm.write(f"{item.name}: failed, {why}")


def make_runs(
    comparison: Comparison, *, most: int | None = None, ray: str | None = None, anew: bool = False
) -> int:
    """Train and evaluate the runs that are not done, and collect their rows.

    ``most`` runs go at a time, by default :data:`JOBS`, or on a cluster all. The exit status is 1
    if a run failed, 128 and the number of the signal that stopped it.
    """
    jobs, wanted = comparison.jobs, comparison.evaluation
    for job in jobs:
        files.check_folder(job.path)
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
            stop = runs.run()
        if stop:
            return stop.exit_status
        collect(jobs, wanted, comparison.folder)
    return 1 if runs.failed else 0


@contextmanager
def workers_of(address: str | None, count: int) -> Iterator[list[Worker]]:
    """Make workers on this machine, or on a cluster."""
    if address is None:
        yield [LocalWorker() for _ in range(count)]
        return
    try:
        from training.comparison.clusters import RemoteWorker, connected
    except ImportError as error:
        raise ValueError(
            "--ray needs Ray: install the extra 'ray', see Install in the README"
        ) from error
    try:
        with connected(address or None):
            yield [RemoteWorker() for _ in range(count)]
    except ConnectionError as error:
        raise ValueError(f"--ray {address}: {error}") from error
