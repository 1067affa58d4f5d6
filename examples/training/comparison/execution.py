"""The runs of a comparison: trained, then evaluated, and begun again where one is lost."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from tqdm import tqdm

from training import files
from training.comparison.jobs import Comparison, Evaluation, Job, collect, other_than_asked
from training.comparison.processes import Child, Lost, Started
from training.stopping import Stop

Start = Callable[[Sequence[str], Path], Started]
"""Starts a command, whose output goes to a file."""
JOBS = 2
"""Runs at a time on one machine."""
_PAUSE = 0.3
"""Between two looks at the runs [s]."""
_MOST_LOSSES = 10
"""Machines that may be lost under a run, which may be what takes them down."""


class Running:
    """A run on its way: trained first, then evaluated, with a line on the screen.

    Args:
        job: The run.
        training: The command that trains it; None if that is done.
        evaluation: The command that evaluates it.
        start: Starts a command.
        position: Its line.
    """

    def __init__(
        self,
        job: Job,
        training: list[str] | None,
        evaluation: list[str],
        *,
        start: Start,
        position: int,
    ) -> None:
        self.job = job
        self.position = position
        self._start = start
        self._commands = [evaluation] if training is None else [training, evaluation]
        job.path.mkdir(parents=True, exist_ok=True)
        self.log = job.path / "output.log"
        self._bar = tqdm(desc=job.name, unit="episode", position=position, leave=False)
        self._child = start(self._commands.pop(0), self.log)

    def ended(self) -> int | None:
        """Exit status of the last command, or of one that failed; None while it runs."""
        status = self.job.status()
        self._bar.total, self._bar.n = status.get("total"), status.get("done", 0)
        self._bar.unit = status.get("unit", "it")
        self._bar.set_postfix_str(status.get("summary", "") if self._commands else "evaluation")
        try:
            exit_status = self._child.ended()
        except Lost:
            self._bar.close()
            raise
        if exit_status == 0 and self._commands:
            self._child = self._start(self._commands.pop(0), self.log)
            return None
        if exit_status is not None:
            self._bar.close()
        return exit_status

    def stop(self) -> None:
        """Ask it to save and end."""
        self._child.stop()

    def wait(self) -> None:
        """Wait until it has."""
        with suppress(Lost):
            self._child.wait()
        self._bar.close()


class Runs:
    """The runs of a comparison that are not done, some of them on their way at a time.

    Args:
        waiting: The runs.
        overrides: Settings of all of them.
        wanted: What their policies shall do.
        anew: Runs to train again from the start.
        start: Starts a command.
        most: How many may be on their way.
    """

    def __init__(
        self,
        waiting: list[Job],
        overrides: Sequence[str],
        wanted: Evaluation,
        *,
        anew: set[Job],
        start: Start,
        most: int,
    ) -> None:
        self.waiting, self.overrides, self.wanted = waiting, overrides, wanted
        self.anew, self.start, self.most = anew, start, most
        self.running: list[Running] = []
        self.failed: list[Job] = []
        self._losses: Counter[Job] = Counter()

    def __bool__(self) -> bool:
        return bool(self.waiting or self.running)

    def begin(self) -> None:
        """Start as many as may be on their way."""
        while self.waiting and len(self.running) < self.most:
            job = self.waiting.pop(0)
            free = min(set(range(self.most)) - {each.position for each in self.running})
            anew = job in self.anew
            trained = job.is_trained() and not anew
            training = None if trained else job.trains(self.overrides, anew=anew)
            evaluation = job.evaluates(self.wanted)
            self.running.append(Running(job, training, evaluation, start=self.start, position=free))

    def look(self) -> None:
        """Take note of those that have ended."""
        for each in list(self.running):
            try:
                status = each.ended()
            except Lost as error:
                self.running.remove(each)
                self._lost(each, error)
                continue
            if status is None:
                continue
            self.running.remove(each)
            if status == 0:
                tqdm.write(f"{each.job.name}: trained and evaluated")
            else:
                self.failed.append(each.job)
                tqdm.write(f"{each.job.name}: failed, see {each.log}")

    def _lost(self, run: Running, error: Lost) -> None:
        """Have a run go on elsewhere."""
        job = run.job
        self._losses[job] += 1
        if self._losses[job] > _MOST_LOSSES:
            self.failed.append(job)
            tqdm.write(f"{job.name}: failed, lost {_MOST_LOSSES} machines: {error}")
            return
        tqdm.write(f"{job.name}: its machine is gone, goes on at its last checkpoint: {error}")
        # Once it has begun anew, it has the settings that are asked for.
        if job in self.anew and not other_than_asked([job], self.overrides):
            self.anew.discard(job)
        self.waiting.insert(0, job)

    def stop(self) -> None:
        """Have all of them save and end."""
        for each in self.running:
            each.stop()
        for each in self.running:
            each.wait()


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
        with _starting(ray if waiting else None) as start:
            most = most or (JOBS if ray is None else len(waiting))
            runs = Runs(
                waiting, comparison.settings, wanted, anew=set(others), start=start, most=most
            )
            stop = _run_all(runs)
        if stop:
            return stop.exit_status
        collect(jobs, wanted, comparison.folder)
    return 1 if runs.failed else 0


@contextmanager
def _starting(address: str | None) -> Iterator[Start]:
    """Whatever starts a command: on this machine, or on a cluster."""
    if address is None:
        yield Child
        return
    try:
        from training.comparison.clusters import RemoteChild, connected
    except ImportError as error:
        raise ValueError("--ray needs Ray: pip install 'torchrl-mpfa[ray]'") from error
    try:
        with connected(address or None):
            yield RemoteChild
    except ConnectionError as error:
        raise ValueError(f"--ray {address}: {error}") from error


def _run_all(runs: Runs) -> Stop:
    """Train and evaluate, some at a time; whether all was stopped."""
    stop = Stop("saving the runs; the same command continues them")
    with stop.listening():
        while runs and not stop:
            runs.begin()
            time.sleep(_PAUSE)
            runs.look()
        runs.stop()
    return stop
