"""Signals: what a priority is made of. ``samplers/table.py`` keeps them for every slot.

A :class:`Signal` says where one number per transition comes from. Some are known when the
transition is written (its reward); the others are learned, and come back with the batch after
the loss (the TD error, the gradient). A user's own signal is one more :class:`Signal`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_mpfa.priorities import reward_priority

SIGNALS_KEY = "signals"
"""The entry of a batch under which the loss writes the learned signals."""


@dataclass(frozen=True)
class Signal:
    """One number per transition that a priority can be made of.

    Args:
        name: Its name, for fusion, statistics and errors.
        key: Where it is read; by default ``("signals", name)``.
        known_at: ``"update"`` (default): it comes with the batch after the loss, and is unknown
            for a fresh transition. ``"write"``: it is read when the transition is stored.
        priority: Function from what is read, shape ``[B]``, to a non-negative number, shape
            ``[B]``; of a learned signal it sees one batch at a time. By default the absolute value
            of a signal that is known at the write; a learned signal is stored unchanged.

    Raises:
        TypeError: If ``priority`` is no function.
        ValueError: If ``name`` is empty or ``known_at`` unknown.

    Examples:
        >>> Signal("novelty").key
        ('signals', 'novelty')
    """

    name: str
    key: NestedKey = ""
    known_at: Literal["update", "write"] = "update"
    priority: Callable[[Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError(f"name must not be empty, got {self.name!r}")
        if not (self.priority is None or callable(self.priority)):
            raise TypeError(f"priority must be a function, got {self.priority!r}")
        if self.known_at not in ("update", "write"):
            raise ValueError(f"known_at must be 'update' or 'write', got {self.known_at!r}")
        if not self.key:
            object.__setattr__(self, "key", (SIGNALS_KEY, self.name))


REWARD = Signal("reward", key=("next", "reward"), known_at="write", priority=reward_priority)
TD_ERROR = Signal("td_error")
ACTION_GRADIENT = Signal("action_gradient")

OF_LEARNERS = ("td_error", "action_gradient", "value", "information_gain")
"""Names of the signals that an :class:`~torchrl_mpfa.ActorCritic` can write."""
MPFA_SIGNALS: tuple[Signal, ...] = (REWARD, TD_ERROR, ACTION_GRADIENT)
"""The three signals of Eqs. (12)-(14)."""


def as_signals(signals: Sequence[Signal | str]) -> tuple[Signal, ...]:
    """Return signals of signals or names; names other than the paper's are of learned signals."""
    if isinstance(signals, str) or not all(isinstance(s, str | Signal) for s in signals):
        raise TypeError(f"signals must be a list of signals or their names, got {signals!r}")
    paper = {signal.name: signal for signal in MPFA_SIGNALS}
    listed = tuple(paper.get(s, Signal(s)) if isinstance(s, str) else s for s in signals)
    names = [signal.name for signal in listed]
    if not names or len(set(names)) != len(names):
        raise ValueError(f"signals must be one or more different signals, got {names}")
    return listed
