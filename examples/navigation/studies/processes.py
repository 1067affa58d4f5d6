"""Child processes that never outlive the program that started them."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from navigation.stopping import lifeline


class Lost(Exception):
    """The machine that a command ran on is gone, and the command with it."""


class Started(Protocol):
    """A command that was started, on this machine or on another."""

    def ended(self) -> int | None:
        """Exit status, or None while it runs.

        Raises:
            Lost: If its machine is gone.
        """
        ...

    def stop(self) -> None:
        """Ask it to end."""
        ...

    def wait(self) -> int:
        """Wait for its end and give the exit status.

        Raises:
            Lost: If its machine is gone.
        """
        ...


class Child:
    """A process that ends when this one does, however that ends.

    It holds one end of a pipe; the system closes the other when this process is gone.

    Args:
        command: Program and arguments; it calls
            :func:`~navigation.stopping.end_with_parent` at its start.
        log: The file that its output is appended to.
    """

    def __init__(self, command: Sequence[str], log: Path) -> None:
        theirs, self._ours = os.pipe()
        try:
            with log.open("ab") as output:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    pass_fds=(theirs,),
                    env=lifeline(theirs),
                    # Ctrl-C goes to this process alone, which says when they stop.
                    start_new_session=True,
                )
        finally:
            os.close(theirs)

    def ended(self) -> int | None:
        """Exit status, or None while it runs."""
        status = self._process.poll()
        if status is not None and self._ours >= 0:
            os.close(self._ours)
            self._ours = -1
        return status

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Send a signal, if it still runs."""
        if self.ended() is None:
            self._process.send_signal(number)

    def wait(self) -> int:
        """Wait for its end and give the exit status."""
        self._process.wait()
        status = self.ended()
        assert status is not None
        return status
