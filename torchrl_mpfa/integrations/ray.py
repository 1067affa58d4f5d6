"""The replay of a method in a process of its own on a Ray cluster, for many writers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import RayReplayBuffer

from torchrl_mpfa.buffer import SignalReplayBuffer
from torchrl_mpfa.methods.assembly import Replay, buffer_parts, learned_signals
from torchrl_mpfa.methods.base import Method


class MethodReplayBuffer(SignalReplayBuffer):
    """A buffer made from the settings of a method.

    Args:
        method: The settings.
        seed: Seed of its randomness.
        **kwargs: Passed to :class:`~torchrl_mpfa.SignalReplayBuffer`.

    Examples:
        >>> from torchrl_mpfa.methods import METHODS
        >>> MethodReplayBuffer(METHODS["per"], seed=3).batch_size
        256
    """

    def __init__(self, method: Method, *, seed: int = 0, **kwargs: Any) -> None:
        generator = torch.Generator().manual_seed(seed)
        super().__init__(**buffer_parts(method), generator=generator, **kwargs)
        # Batches of several updates are sampled in one call, of which TorchRL would warn.
        self._warned_batch_size_conflict = True


class _AloneInProcess(MethodReplayBuffer):
    """A buffer in a process of its own, whose seed is that of the transforms too."""

    def __init__(self, method: Method, *, seed: int = 0, **kwargs: Any) -> None:
        torch.manual_seed(seed)
        super().__init__(method, seed=seed, **kwargs)


class RaySignalReplayBuffer(RayReplayBuffer):
    """TorchRL's :class:`~torchrl.data.RayReplayBuffer` around a :class:`MethodReplayBuffer`.

    Batches go out and signals come back as in the process: a row that was overwritten in between is
    left out, whoever wrote it, and ``state_dict`` is that of a :class:`SignalReplayBuffer`.

    Args:
        method: The settings.
        seed: Seed of all randomness of the buffer.
        remote_config: Resources of the process of the buffer, as in ``ray.remote``.
    """

    takes_signals = True
    priority_key = "td_error"

    def __init__(
        self, method: Method, *, seed: int = 0, remote_config: dict[str, Any] | None = None
    ) -> None:
        super().__init__(
            method,
            seed=seed,
            replay_buffer_cls=_AloneInProcess,
            remote_config={"num_cpus": 0} if remote_config is None else remote_config,
        )
        self._rows = method.rows
        self._like = method.sampler()

    @property
    def batch_size(self) -> int:
        """Transitions of a batch."""
        return self._rows

    @property
    def sampler(self) -> Any:
        """A sampler with the settings of the one in use, and nothing of its state but beta."""
        return self._like

    def rewards(self) -> torch.Tensor:
        """Rewards of all transitions, shape ``[N]``."""
        return self._client.rewards()

    def distributions(self) -> dict[str, torch.Tensor]:
        """See :meth:`SignalReplayBuffer.distributions`."""
        return self._client.distributions()

    def update_tensordict_priority(self, data: TensorDictBase, *, batches: int = 1) -> None:
        """See :meth:`SignalReplayBuffer.update_tensordict_priority`."""
        self._client.update_tensordict_priority(data, batches=batches)

    def anneal(self, beta: float, fraction: float) -> None:
        """See :meth:`SignalReplayBuffer.anneal`."""
        if hasattr(self._like, "beta"):
            self._like.beta = beta
        self._client.anneal(beta, fraction)


def make_ray_replay(
    method: Method,
    *,
    seed: int = 0,
    policy: TensorDictModule | None = None,
    sigma: float | Callable[[], float] | None = None,
    remote_config: dict[str, Any] | None = None,
) -> Replay:
    """Make a replay with its buffer in a process of a Ray cluster.

    Args:
        method: The settings.
        seed: Seed of all randomness of the buffer.
        policy: See :func:`~torchrl_mpfa.methods.make_replay`.
        sigma: See :func:`~torchrl_mpfa.methods.make_replay`.
        remote_config: Resources of that process, as in ``ray.remote``.

    Returns:
        The replay, whose ``buffer.clients(W)`` are for the processes that write in it.

    Raises:
        ValueError: If the method selects by the state of the buffer, as LA3P and ReF-ER do, or
            needs extra entries.
    """
    if not method.remote:
        raise ValueError(f"method {method.name!r} needs its buffer in the process that learns")
    buffer = RaySignalReplayBuffer(method, seed=seed, remote_config=remote_config)
    select = method.selection(policy, sigma)
    return Replay(buffer, select, tuple(learned_signals(method)), method)
