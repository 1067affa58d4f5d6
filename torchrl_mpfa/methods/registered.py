"""Signals of one's own by name, which methods name as they name the paper's."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING, Any

from torchrl_mpfa.signals import OF_LEARNERS

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torch import Tensor

    from torchrl_mpfa.selection import SampledBatch

SignalFunction = Callable[..., Any]
"""From a learner and a batch to a signal, shape ``[B]``."""
SIGNALS: dict[str, SignalFunction | type[SignalFunction]] = {}
"""The registered signals by name; :func:`register_signal` adds one."""


def register_signal(name: str, signal: SignalFunction | type[SignalFunction]) -> None:
    """Add a signal, for this process.

    Args:
        name: Its name, in the ``signals`` of a method.
        signal: Function from a learner and a batch of ``[B]`` transitions to non-negative numbers,
            shape ``[B]``; or a class of such objects, of which each run makes one. What its
            ``state_dict()`` gives, if it has one, is saved with the run.

    Raises:
        TypeError: If the signal cannot be called.
        ValueError: If a loss has a signal of this name.

    Examples:
        >>> def size(learner, batch):
        ...     return batch["action"].square().sum(-1)
        >>> register_signal("size", size)  # doctest: +SKIP
    """
    if not callable(signal):
        raise TypeError(f"signal must be a function or a class, got {signal!r}")
    if not name or name in ("reward", *OF_LEARNERS):
        raise ValueError(f"name must be one that no loss has, got {name!r}")
    SIGNALS[name] = signal


class OwnSignals:
    """The registered signals of a run, of classes one object each.

    Args:
        names: Learned signals of the method; those that no one registered are left out.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torch import ones
        >>> register_signal("ones", lambda learner, batch: ones(len(batch)))
        >>> batch = TensorDict({}, [2])
        >>> OwnSignals(["td_error", "ones"]).write(None, batch)
        >>> batch["signals", "ones"].tolist()
        [1.0, 1.0]
        >>> _ = SIGNALS.pop("ones")
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._functions: dict[str, SignalFunction] = {}
        for name in names:
            if name in SIGNALS:
                signal = SIGNALS[name]
                self._functions[name] = signal() if isinstance(signal, type) else signal

    def __len__(self) -> int:
        return len(self._functions)

    def write(self, learner: Any, batch: TensorDictBase) -> None:
        """Write the signals in a batch, before the learner learns from it."""
        for name, function in self._functions.items():
            value: Tensor = function(learner, batch)
            if value.shape != batch.shape[:1]:
                raise ValueError(
                    f"signal {name!r} must have shape {[*batch.shape[:1]]}, got {[*value.shape]}"
                )
            batch["signals", name] = value.detach()

    def before(self, learner: Any) -> Callable[[SampledBatch], SampledBatch]:
        """Return the ``prepare`` of :func:`~torchrl_mpfa.run_updates` that writes the signals."""
        write = partial(self.write, learner)
        return lambda sampled: sampled.each(write) if sampled.gives_signals else sampled

    def state_dict(self) -> dict[str, Any]:
        """Return the states of those that have one."""
        both = [(n, f) for n, f in self._functions.items() if hasattr(f, "load_state_dict")]
        return {n: f.state_dict() for n, f in both if hasattr(f, "state_dict")}

    def load_state_dict(self, states: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name, state in states.items():
            self._functions[name].load_state_dict(state)  # type: ignore[attr-defined]
