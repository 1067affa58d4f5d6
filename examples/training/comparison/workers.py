"""Processes that make one run after another, and never outlive the program that started them."""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import runpy
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from queue import SimpleQueue
from typing import Protocol

from torchrl_mpfa.stopping import SIGNALS
from training.files import no_room
from training.inherited import forget_single_run

Command = tuple[list[str], str]
"""A script with its arguments, and the file that its output is appended to."""


class Lost(Exception):
    """The process or the machine that a script ran on is gone, and the script with it."""


class Worker(Protocol):
    """Maker of runs, one at a time, on this machine or on another."""

    def ready(self) -> bool:
        """Return True if a script would begin at once."""
        ...

    def start(self, command: Sequence[str], log: Path) -> None:
        """Start a script, whose output is appended to a file."""
        ...

    def ended(self) -> int | None:
        """Return the exit status of the script, None while it runs.

        Raises:
            Lost: If the script is lost.
            OSError: If the script had no room on a disk.
        """
        ...

    def stop(self) -> None:
        """Ask the script to save and end, and the worker with it."""
        ...

    def wait(self) -> None:
        """Wait until it has."""
        ...


class LocalWorker:
    """A process of this machine that runs scripts one after another, each as if it were alone.

    What a script imports, loads and compiles is there for the next one, which is most of the time
    of a short run. A process that is gone is replaced when the next script begins.
    """

    def __init__(self) -> None:
        self._process: SpawnProcess | None = None
        self._commands: Connection
        self._statuses: Connection

    def ready(self) -> bool:
        """Return True if a script would begin at once."""
        return True

    def start(self, command: Sequence[str], log: Path) -> None:
        """Start a script, whose output is appended to a file."""
        if self._process is None:
            context = multiprocessing.get_context("spawn")
            theirs, self._commands = context.Pipe(duplex=False)
            self._statuses, its = context.Pipe(duplex=False)
            with theirs, its:
                self._process = context.Process(target=_work, args=(theirs, its), name="worker")
                self._process.start()
        # A process that is gone by now is missed when it is asked for the end.
        with suppress(BrokenPipeError):
            self._commands.send((list(command), str(log)))

    def ended(self) -> int | None:
        """Return the exit status of the script, None while it runs; raise :class:`Lost` if lost."""
        try:
            status = self._statuses.recv() if self._statuses.poll() else None
        except (EOFError, ConnectionResetError):
            process = self._process
            self.stop()
            self.wait()
            raise Lost(f"its process ended with {process and process.exitcode}") from None
        if isinstance(status, OSError):
            raise status
        return status if status is None else int(status)

    def stop(self) -> None:
        """Ask the script to save and end, and the process with it."""
        if self._process is not None:
            self._commands.close()

    def wait(self) -> None:
        """Wait until it has."""
        if self._process is not None:
            self._process.join()
            self._statuses.close()
            self._process = None


def _work(sent: Connection, statuses: Connection) -> None:
    """Run scripts until the program that sends them is gone, or one was asked to stop."""
    # Ctrl-C goes to the parent alone, which says when they stop.
    os.setsid()
    # Where a script does not say how it ends by one: in good order as well.
    for number in set(SIGNALS) - {signal.SIGINT}:
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    # Another machine has an environment of its own.
    forget_single_run()
    commands: SimpleQueue[Command | None] = SimpleQueue()
    threading.Thread(target=_listen, args=(sent, commands), daemon=True, name="lifeline").start()
    try:
        while (command := commands.get()) is not None:
            status = _run(*command)
            if isinstance(status, int) and status >= 128:
                raise SystemExit(status)
            with suppress(BrokenPipeError):
                statuses.send(status)
    finally:
        # Triton would report what is not freed at the end.
        gc.unfreeze()


def _listen(sent: Connection, commands: SimpleQueue[Command | None]) -> None:
    """Take commands; when the other end is closed, however, end by SIGTERM."""
    with suppress(EOFError, OSError):
        while True:
            commands.put(sent.recv())
    # For a script that has come to its end in spite of the signal.
    commands.put(None)
    os.kill(os.getpid(), signal.SIGTERM)


def _run(command: list[str], log: str) -> int | OSError:
    """Run a script as ``python`` would; return its exit status, or the error of a full disk."""
    status: int | OSError = 0
    try:
        output = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        for stream in (1, 2):
            os.dup2(output, stream)
        os.close(output)
        with _unchanged():
            sys.argv = command
            runpy.run_path(command[0], run_name="__main__")
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        number = end.code if isinstance(end.code, int) else int(end.code is not None)
        status = no_room(end) or number
    except Exception as error:
        status = no_room(error) or 1
        with suppress(OSError):
            traceback.print_exc()
    with suppress(OSError):
        sys.stdout.flush()
    # What a run leaves has cycles, and large buffers in them. What is loaded by now is kept, and
    # need not be gone through by each collection after this one.
    gc.collect()
    gc.freeze()
    return status


@contextmanager
def _unchanged() -> Iterator[None]:
    """Leave the process to the next script as it was found, but for what is loaded."""
    import torch

    environment, folder = dict(os.environ), Path.cwd()
    arguments = sys.argv
    threads, numbers = torch.get_num_threads(), torch.get_rng_state()
    level, handlers = logging.root.level, list(logging.root.handlers)
    try:
        with warnings.catch_warnings():
            yield
    finally:
        os.environ.clear()
        os.environ.update(environment)
        os.chdir(folder)
        sys.argv = arguments
        logging.root.setLevel(level)
        logging.root.handlers[:] = handlers
        torch.set_num_threads(threads)
        torch.set_rng_state(numbers)
        torch.set_flush_denormal(False)
