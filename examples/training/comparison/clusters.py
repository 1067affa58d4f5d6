"""The workers of a comparison on the machines of a Ray cluster, each an actor of one core."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import ray
from ray import exceptions

from training import files
from training.comparison.workers import LocalWorker, Lost

_PAUSE = 0.3
"""Between two looks at a script [s]."""
_PATIENCE = 150.0
"""How long a folder may stay locked after its machine is gone [s]. NFS lets go after 90."""
_MOST_IN_VAIN = 10
"""Machines that a worker may lose before it is of use."""
_GONE = (
    exceptions.RayActorError,
    exceptions.NodeDiedError,
    exceptions.WorkerCrashedError,
    exceptions.LocalRayletDiedError,
    exceptions.OutOfMemoryError,
)


class RemoteWorker:
    """A worker on whichever machine of the cluster has a core to spare.

    It is what :class:`~training.comparison.workers.LocalWorker` is on this machine. All machines
    must find programs and folders where this one has them.
    """

    def __init__(self) -> None:
        self._actor: Any = None
        self._begun: Any = None
        self._task: Any = None
        self._stopped: Any = None
        self._in_vain = 0
        self._log = Path()

    def ready(self) -> bool:
        """Return True if a machine has a core for it, which the first call asks for."""
        if self._actor is None:
            # Two calls at a time: a script, and what asks it to stop.
            options = {"num_cpus": 1, "max_concurrency": 2, "scheduling_strategy": "SPREAD"}
            self._actor = ray.remote(**options)(_Host).remote()
            self._begun = self._actor.begun.remote()
        if not ray.wait([self._begun], timeout=0)[0]:
            return False
        try:
            ray.get(self._begun)
        except _GONE:
            # Its machine was gone before it had a run. What always fails is a run's own loss.
            self._in_vain += 1
            if self._in_vain <= _MOST_IN_VAIN:
                self._actor = None
                return False
        return True

    def start(self, command: Sequence[str], log: Path) -> None:
        """Start a script, whose output is appended to a file."""
        self._log = log
        self._task = self._actor.run.remote(list(command), log, Path.cwd())

    def ended(self) -> int | None:
        """Return the exit status of the script, None while it runs; raise :class:`Lost` if lost."""
        done, _ = ray.wait([self._task], timeout=0)
        if not done:
            return None
        try:
            return int(ray.get(self._task))
        except (Lost, *_GONE) as error:
            self.wait()
            raise Lost(str(error).strip().splitlines()[-1]) from error
        except exceptions.RayTaskError as error:
            if (full := files.no_room(error.cause)) is not None:
                raise full from None
            with self._log.open("a", encoding="utf-8") as log:
                log.write(f"{error}\n")
            return 1

    def stop(self) -> None:
        """Ask the script to save and end, or the cluster no longer for a core."""
        if self._actor is not None and self.ready():
            self._stopped = self._actor.stop.remote()

    def wait(self) -> None:
        """Wait until it has, and give the core back."""
        if self._stopped is not None:
            with suppress(exceptions.RayError):
                ray.get(self._stopped)
        if self._actor is not None:
            ray.kill(self._actor)
        self._actor = self._stopped = None


class _Host:
    """The part of a worker on its machine: a process that scripts have to themselves."""

    def __init__(self) -> None:
        self._worker = LocalWorker()

    def begun(self) -> None:
        """Return once there is a core."""

    def run(self, command: list[str], log: Path, folder: Path) -> int:
        """Run a script where the comparison would have run it; its exit status."""
        os.chdir(folder)
        if not log.parent.is_dir():
            raise FileNotFoundError(
                f"{os.uname().nodename} does not have {log.parent.resolve()}: the machines of the "
                "cluster must share the comparison's folder"
            )
        # The run may have been begun on a machine that is gone, or takes its time to be.
        files.wait_until_free(log.parent, _PATIENCE)
        self._worker.start(command, log)
        while (status := self._worker.ended()) is None:
            time.sleep(_PAUSE)
        return status

    def stop(self) -> None:
        """Have the script save and end."""
        self._worker.stop()
        self._worker.wait()


@contextmanager
def connected(address: str | None) -> Iterator[None]:
    """Use a cluster by the address of its head, as ``ray.init`` takes the address.

    None: that of ``RAY_ADDRESS``, a cluster on this machine, or else the cores of this machine.
    """
    ray.init(address, include_dashboard=False, log_to_driver=False, configure_logging=False)
    try:
        yield
    finally:
        ray.shutdown()
