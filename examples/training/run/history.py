"""Record signals, priorities and importance weights of a buffer during training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_mpfa import SignalReplayBuffer
from torchrl_mpfa.checks import COUNT_OR_ZERO, check, check_counts

_LOW, _HIGH = 1e-6, 1e6
"""Ends of the bins; what lies beyond counts to the outermost ones."""


class ReplayHistory:
    """Histograms of all transitions in a buffer, at one time after another.

    They hold each signal as it was last written, the priority, and the importance weight of
    Eq. (10) that the transition would have in a batch. Bins are equal on a logarithmic scale, those
    of ten to the power of -6 to 6; zeros are in the lowest. A buffer without priorities adds
    nothing.

    Args:
        bins: Bins for each power of ten.

    Raises:
        ValueError: If ``bins`` is not a positive integer.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_mpfa import MPFASampler, SignalTensorStorage
        >>> buffer = SignalReplayBuffer(
        ...     storage=SignalTensorStorage(100), sampler=MPFASampler(100), batch_size=4
        ... )
        >>> _ = buffer.extend(TensorDict({"next": {"reward": torch.rand(10, 1)}}, [10]))
        >>> history = ReplayHistory()
        >>> history.add(1000, buffer)
        >>> sorted(history.histograms())
        ['priority', 'reward', 'weight']
    """

    def __init__(self, *, bins: int = 24) -> None:
        count = round(np.log10(_HIGH / _LOW)) * check_counts(bins=bins)
        self.edges: Any = np.geomspace(_LOW, _HIGH, count + 1)
        """Ends of the bins, ``[E + 1]``."""
        self._steps: dict[str, list[int]] = {}
        self._counts: dict[str, list[Any]] = {}

    def add(self, step: int, buffer: SignalReplayBuffer) -> None:
        """Add histograms of a buffer as it is, or raise ``ValueError`` for a step that is no count.

        Args:
            step: The time, such as the number of actions so far.
            buffer: The buffer.
        """
        step = check(COUNT_OR_ZERO, step=step)
        for name, values in buffer.distributions().items():
            self._count(name, step, values)

    def _count(self, name: str, step: int, values: Tensor) -> None:
        numbers = values.detach().double().cpu().numpy().reshape(-1)
        numbers = numbers[np.isfinite(numbers)]
        if len(numbers):
            inside = numbers.clip(_LOW, _HIGH)
            self._steps.setdefault(name, []).append(step)
            self._counts.setdefault(name, []).append(np.histogram(inside, self.edges)[0])

    def histograms(self) -> dict[str, tuple[Any, Any, Any]]:
        """Steps ``[T]``, edges of bins ``[E + 1]`` and counts ``[T, E]`` by signal.

        ``mpfa_envs.render.plot_histograms`` plots them.
        """
        return {
            name: (np.array(self._steps[name]), self.edges, np.stack(counts))
            for name, counts in self._counts.items()
        }

    def state_dict(self) -> dict[str, Any]:
        """All histograms; tensors and plain values only."""
        return {
            name: {"steps": list(self._steps[name]), "counts": torch.from_numpy(np.stack(counts))}
            for name, counts in self._counts.items()
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Raises:
            ValueError: If it has other bins; nothing is changed then.
        """
        bins = len(self.edges) - 1
        for name, state in state_dict.items():
            if tuple(state["counts"].shape) != (len(state["steps"]), bins):
                raise ValueError(
                    f"counts of {name!r} must have shape {(len(state['steps']), bins)}, got "
                    f"{tuple(state['counts'].shape)}"
                )
        self._steps = {name: list(state["steps"]) for name, state in state_dict.items()}
        self._counts = {name: list(state["counts"].numpy()) for name, state in state_dict.items()}
