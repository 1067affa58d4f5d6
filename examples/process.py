"""The processes of a run: what holds for each, and how a second one serves the first."""

from __future__ import annotations

import logging
import os
import signal
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import torch
from torch import multiprocessing

from settings import TrainSettings

_PATIENCE = 10.0
"""How long a process may take to end [s]."""


def prepare_process(settings: TrainSettings) -> None:
    """Set threads, arithmetic and logging."""
    torch.set_num_threads(settings.threads)
    # Weights that no gradient reaches decay until they are denormal numbers; after some five
    # thousand updates a CPU takes twice as long for each because of them.
    torch.set_flush_denormal(True)
    # By default a pool of processes would wait for programs to compile, of which there are two.
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
    # TorchRL announces each storage in the middle of the progress bar.
    logging.getLogger("torchrl").setLevel(logging.WARNING)


@dataclass(frozen=True)
class _Failure:
    text: str


class Companion:
    """A second process that answers this one, and ends when this one does, however that ends.

    It has no copy of this end of the pipe between the two, so that its next word to it fails once
    this process is gone. The workers of ``concurrent.futures`` would wait forever.

    Args:
        name: What it is called in errors.
        serve: Its program, a function of a module: called there with its end of the pipe, the
            settings and ``arguments``; to return or to fail ends it.
        settings: Of the run.
        *arguments: Tensors and modules in shared memory stay shared.
    """

    def __init__(
        self,
        name: str,
        serve: Callable[..., None],
        settings: TrainSettings,
        *arguments: object,
    ) -> None:
        self._name = name
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(serve, other, settings, *arguments), daemon=True
        )
        self._process.start()
        other.close()

    def send(self, message: object) -> None:
        """Say something.

        Raises:
            RuntimeError: If the process has ended.
        """
        try:
            self._connection.send(message)
        except OSError as error:
            raise self._ended() from error

    def receive(self) -> Any:
        """Wait for an answer.

        Raises:
            RuntimeError: If the process failed or has ended; with its error.
        """
        try:
            answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise self._ended() from error
        if isinstance(answer, _Failure):
            raise RuntimeError(f"the {self._name} failed in its process:\n{answer.text}")
        return answer

    def has_answered(self) -> bool:
        """Whether :meth:`receive` would not wait."""
        return self._connection.poll()

    def close(self) -> None:
        """End the process."""
        self._connection.close()
        self._process.join(_PATIENCE)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _ended(self) -> RuntimeError:
        self._process.join(_PATIENCE)
        return RuntimeError(
            f"the process of the {self._name} has ended, exit status {self._process.exitcode}"
        )


def _serve(
    serve: Callable[..., None],
    connection: Connection,
    settings: TrainSettings,
    *arguments: object,
) -> None:
    # Ctrl-C goes to both processes; the first one says when to stop.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prepare_process(settings)
    try:
        serve(connection, settings, *arguments)
    except (EOFError, ConnectionError):
        pass  # The first process is done, or was killed.
    except Exception:
        connection.send(_Failure(traceback.format_exc()))
