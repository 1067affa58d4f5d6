"""Child processes that never outlive the program that started them."""

from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import sys
from collections.abc import Sequence
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Protocol

from training.comparison.jobs import SCRIPTS
from training.stopping import end_with


class Lost(Exception):
    """The machine that a command ran on is gone, and the command with it."""


class Started(Protocol):
    """A command that was started, on this machine or on another."""

    def ended(self) -> int | None:
        """Exit status, or None while it runs."""
        ...

    def stop(self) -> None:
        """Ask it to end."""
        ...

    def wait(self) -> int:
        """Wait for its end and give the exit status."""
        ...


class Child:
    """A Python script in a process that ends when this one does, however that ends.

    It is forked from a server that has imported what scripts need, seven seconds of computing
    otherwise. It holds one end of a pipe; the system closes the other when this process is gone.

    Args:
        command: A script and its arguments.
        log: The file that its output is appended to.
    """

    def __init__(self, command: Sequence[str], log: Path) -> None:
        context = _server()
        theirs, self._ours = context.Pipe(duplex=False)
        with theirs:
            self._process = context.Process(
                target=_run, args=(list(command), str(log), theirs), name=Path(command[0]).stem
            )
            self._process.start()

    def ended(self) -> int | None:
        """Exit status, or None while it runs."""
        status = self._process.exitcode
        if status is not None:
            self._ours.close()
        return status

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Send a signal, if it still runs."""
        if self.ended() is None and self._process.pid is not None:
            os.kill(self._process.pid, number)

    def wait(self) -> int:
        """Wait for its end and give the exit status."""
        self._process.join()
        status = self.ended()
        assert status is not None
        return status


def _server() -> ForkServerContext:
    """What forks processes from one that has imported the scripts."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["train", "evaluate"])
    before = os.environ.get("PYTHONPATH")
    # The server looks for what it imports there alone.
    os.environ["PYTHONPATH"] = os.pathsep.join(path for path in (str(SCRIPTS), before) if path)
    try:
        forkserver.ensure_running()
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before
    return context


def _run(command: list[str], log: str, parent: Connection) -> None:
    """Run a script as ``python`` would."""
    # Ctrl-C goes to the parent alone, which says when they stop.
    os.setsid()
    end_with(parent)
    output = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.close(output)
    sys.argv = command
    runpy.run_path(command[0], run_name="__main__")
