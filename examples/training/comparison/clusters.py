"""The commands of a comparison on the machines of a Ray cluster, each as a task of one core."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import ray
from ray import exceptions

from training import files
from training.comparison.processes import Child, Lost

_PAUSE = 0.3
"""Between two looks at a command [s]."""
_PATIENCE = 150.0
"""How long a folder may stay locked after its machine is gone [s]. NFS lets go after 90."""
_GONE = (
    exceptions.NodeDiedError,
    exceptions.WorkerCrashedError,
    exceptions.LocalRayletDiedError,
    exceptions.OutOfMemoryError,
)


class RemoteChild:
    """A command on whichever machine of the cluster has a core to spare.

    It is what :class:`~training.comparison.processes.Child` is on this machine. All machines must
    find programs and folders where this one has them.

    Args:
        command: Program and arguments.
        log: The file that its output is appended to.
    """

    def __init__(self, command: Sequence[str], log: Path) -> None:
        self._log = log
        options = {"num_cpus": 1, "max_retries": 0, "scheduling_strategy": "SPREAD"}
        self._task = ray.remote(**options)(_run).remote(list(command), log, Path.cwd())

    def ended(self) -> int | None:
        """Exit status, or None while it runs or waits for a core."""
        done, _ = ray.wait([self._task], timeout=0)
        return self.wait() if done else None

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Send it SIGTERM, or take it out of the queue."""
        ray.cancel(self._task)

    def wait(self) -> int:
        """Wait for its end and give the exit status."""
        try:
            return int(ray.get(self._task))
        except exceptions.TaskCancelledError:
            return 128 + signal.SIGTERM
        except _GONE as error:
            raise Lost(str(error).splitlines()[0]) from error
        except exceptions.RayTaskError as error:
            with self._log.open("a", encoding="utf-8") as log:
                log.write(f"{error}\n")
            return 1


@contextmanager
def connected(address: str | None) -> Iterator[None]:
    """Use a cluster.

    Args:
        address: Of its head, as ``ray.init`` takes it; None: that of ``RAY_ADDRESS``, one that was
            started on this machine, or else the cores of this machine.

    Raises:
        ConnectionError: If there is none.
    """
    ray.init(address, include_dashboard=False, log_to_driver=False, configure_logging=False)
    try:
        yield
    finally:
        ray.shutdown()


def _run(command: list[str], log: Path, folder: Path) -> int:
    """Run a command where the comparison would have run it; cancelling it stops it by SIGTERM."""
    os.chdir(folder)
    if not log.parent.is_dir():
        raise FileNotFoundError(
            f"{os.uname().nodename} does not have {log.parent.resolve()}: the machines of the "
            "cluster must share the comparison's folder"
        )
    # The run may have been begun on a machine that is gone, or takes its time to be.
    files.wait_until_free(log.parent, _PATIENCE)
    child = Child(command, log)
    try:
        while (status := child.ended()) is None:
            time.sleep(_PAUSE)
    except KeyboardInterrupt:
        child.stop()
        return child.wait()
    return status
