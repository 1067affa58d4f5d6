"""Early ends of a run: Ctrl-C, a scheduler, a closed terminal, a parent gone, or a hook."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
"""The last two are what Slurm and its like send before the time of a job is over."""


class Stop:
    """Flag that a program was asked to stop, with the number of the signal.

    The first signal lets the program end in good order, and prints the answer; the second stops it.
    ``except KeyboardInterrupt`` does not do: inside a module of TorchRL, an interrupt becomes a
    ``RuntimeError``.

    Args:
        answer: Text that the first signal prints.
        write: Function that prints the text; None: to the standard error.

    Examples:
        >>> from torchrl_mpfa import Stop
        >>> stop = Stop()
        >>> bool(stop), stop.ask(), bool(stop), stop.exit_status
        (False, None, True, 0)
    """

    def __init__(
        self, answer: str = "stopping and saving", *, write: Callable[[str], object] | None = None
    ) -> None:
        self.answer = answer
        self._write = write or (lambda text: sys.stderr.write(f"{text}\n"))
        self.signal: int | None = None
        """Number of the signal, 0 if the program itself asked, None if nobody did."""

    def __bool__(self) -> bool:
        return self.signal is not None

    @property
    def exit_status(self) -> int:
        """As shells have it: 128 and the number of the signal; 0 if there was none."""
        return 128 + self.signal if self.signal else 0

    def ask(self, number: int = 0, frame: FrameType | None = None) -> None:
        """Ask to stop, without a number from within the program; a handler of signals."""
        if number == 0:
            self.signal = self.signal or 0
            return
        if self.signal:
            raise KeyboardInterrupt
        self.signal = number
        name = signal.Signals(number).name
        self._write(f"{name}: {self.answer}; once more to stop at once")

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Let signals ask to stop."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self.ask) for number in SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
