"""The replay of a method: buffer, selection, and the signals that an update has to write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.data import Storage

from torchrl_mpfa.buffer import SignalReplayBuffer
from torchrl_mpfa.checks import SHARE, check
from torchrl_mpfa.methods.base import Method
from torchrl_mpfa.methods.catalogue import method_named
from torchrl_mpfa.selection import Selection
from torchrl_mpfa.signals import OF_LEARNERS
from torchrl_mpfa.storages.tensor import SignalTensorStorage


@dataclass(frozen=True)
class Replay:
    """The replay of a method.

    Attributes:
        buffer: Where transitions are stored and sampled.
        select: Samples the batches of one training step from the buffer.
        signals: The signals that an update has to write, by name.
        method: The settings that it was made from.
        entries: Names of extra entries that transitions must contain: ``"episode"``, a
            number, shape ``[B, 1]``; ``"behavior_mean"``, the action without its noise, ``[B, A]``,
            and ``"behavior_sigma"``, the standard deviation of that, ``[B, 1]``.
    """

    buffer: SignalReplayBuffer
    select: Selection
    signals: tuple[str, ...]
    method: Method
    entries: tuple[str, ...] = ()

    def anneal(self, fraction: float) -> None:
        """Move beta of Eq. (10), linearly, and the weights of a fusion with a schedule.

        Args:
            fraction: How much of the training is done.

        Raises:
            ValueError: If ``fraction`` is not in [0, 1].

        Examples:
            >>> replay = make_replay("per", capacity=1_000)
            >>> replay.anneal(0.5)
            >>> replay.buffer.sampler.beta
            0.7
        """
        check(SHARE, fraction=fraction)
        beta = self.method.beta_at(fraction)
        if beta is not None:
            self.buffer.anneal(beta, fraction)


def make_replay(
    method: str | Method = "mpfa_per",
    *,
    capacity: int | None = None,
    batch_size: int | None = None,
    generator: torch.Generator | None = None,
    storage: Storage | None = None,
    device: torch.device | str = "auto",
    policy: TensorDictModule | None = None,
    sigma: float | Callable[[], float] | None = None,
    **settings: Any,
) -> Replay:
    """Make the replay of a method: buffer, selection, and the signals that an update has to write.

    Args:
        method: A name out of :data:`~torchrl_mpfa.methods.METHODS`, or a method of your own.
        capacity: Slots of the buffer; by default those of the storage, or of the method.
        batch_size: Transitions of a batch; by default the method's.
        generator: Source of all randomness; by default a new one that ``torch.manual_seed`` rules.
        storage: Storage of the transitions; by default a new
            :class:`~torchrl_mpfa.SignalTensorStorage`. It must keep the signals of the method.
        device: Device of a new storage; ``"auto"``: that of the first transition.
        policy: The policy in training, whose actions ReF-ER compares.
        sigma: Standard deviation of the exploration noise in units of the action, or a function
            that returns that of the current episode; for methods that ask for it.
        **settings: Other values for the settings of the method.

    Returns:
        The replay.

    Raises:
        ValueError: If a method, a setting or its value is unknown or out of its range, or if a
            method that needs ``policy`` or ``sigma`` gets none.
        TypeError: If the storage keeps no signals.

    Examples:
        >>> replay = make_replay("la3p", capacity=10_000, batch_size=256)
        >>> replay.signals
        ('td_error',)
        >>> type(replay.buffer.sampler).__name__
        'LA3PSampler'
    """
    if capacity is None and storage is not None:
        capacity = storage.max_size
    given = {"capacity": capacity, "batch_size": batch_size}
    given = {name: value for name, value in given.items() if value is not None}
    chosen = method_named(method, **given, **settings)
    given_parts = {"policy": policy, "sigma": sigma}
    missing = " and ".join(name for name in chosen.needs if given_parts[name] is None)
    if missing:
        raise ValueError(f"method {chosen.name!r} needs {missing}: {chosen.why}")
    parts = buffer_parts(chosen, storage=storage, device=device)
    buffer = SignalReplayBuffer(**parts, generator=generator)
    select = chosen.selection(policy, sigma)
    return Replay(buffer, select, tuple(learned_signals(chosen)), chosen, chosen.entries)


def buffer_parts(
    method: Method, *, storage: Storage | None = None, device: torch.device | str = "auto"
) -> dict[str, Any]:
    """Return storage, sampler and batch size of a method, as arguments of a buffer."""
    if storage is None:
        storage = SignalTensorStorage(method.capacity, device=device)
    return {"storage": storage, "sampler": method.sampler(), "batch_size": method.rows}


def loss_options(method: str | Method) -> dict[str, Any]:
    """Keyword arguments of :class:`~torchrl_mpfa.ActorCritic` that a method needs.

    Args:
        method: A name, or a method of your own.

    Returns:
        ``signals``, of which your own are left out, ``importance``, ``loss_function`` and
        ``pal_alpha``, and those that the class of the method's learner has beyond these.

    Raises:
        ValueError: If the method is unknown.

    Examples:
        >>> loss_options("lap")["loss_function"]
        'smooth_l1'
    """
    chosen = method_named(method)
    return {
        "signals": [name for name in learned_signals(chosen) if name in OF_LEARNERS],
        "importance": chosen.importance,
        "loss_function": chosen.loss_function,
        "pal_alpha": chosen.pal_alpha,
        **chosen.learner_options(),
    }


def learned_signals(method: Method) -> list[str]:
    """Return the last parts of the keys at which an update writes the signals of a method."""
    keys = [signal.key for signal in method.priority_signals() if signal.known_at == "update"]
    return sorted({key[-1] if isinstance(key, tuple) else key for key in keys})
