"""What a run learned from, every so many actions: a row, and histograms of its buffer."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchrl_mpfa import SignalReplayBuffer
from torchrl_mpfa.checks import COUNT_OR_ZERO, check, check_counts

if TYPE_CHECKING:
    import pandas as pd

_NEVER = -1
COLUMNS = (
    "total_steps",
    "episode",
    "updates",
    "reward",
    "average_reward",
    "td_error",
    "td_error_age",
    "td_error_age_buffer",
    "fresh",
    "positive_batch",
    "positive_buffer",
    "phi",
)
"""Those of every method, each explained in ``docs/metrics.md``; ``weight_SIGNAL`` come after."""


class UpdateLog:
    """Rows of what the critic learned from, and how long ago it had last seen that.

    A method's priorities know the TD error that a transition had when the critic last learned from
    it. That age is kept here for every slot, of uniform replay too, which could not do without it
    if it had priorities.

    Args:
        capacity: Slots of the buffer.
        reward_scale: Factor of rewards in the loss; TD errors are in units of the reward.
    """

    def __init__(self, capacity: int, *, reward_scale: float) -> None:
        self.rows: list[dict[str, float]] = []
        self.history = ReplayHistory()
        """Histograms of signals, priorities and weights at the time of each row."""
        self._scale = reward_scale
        self._reward, self._actions, self._updates = 0.0, 0, 0
        self.forget(capacity)

    def forget(self, capacity: int) -> None:
        """Begin with an empty buffer."""
        self._learned_at = torch.full((capacity,), _NEVER, dtype=torch.long)
        self._index = self._before = torch.empty(0, dtype=torch.long)
        self._squares: Tensor | None = None

    def wrote(self, index: Tensor, rewards: Tensor) -> None:
        """Record new transitions.

        Args:
            index: Their slots, and those of what was written in hindsight, shape ``[B]``.
            rewards: Of what the robots did, shape ``[N, 1]``.
        """
        self._learned_at[index] = _NEVER
        self._reward += float(rewards.sum())
        self._actions += len(rewards)

    def learns(self, index: Tensor) -> None:
        """Record that the critic learns from a batch; to call before the update.

        Args:
            index: Its slots, shape ``[B]``.
        """
        self._index, self._before = index, self._learned_at[index]
        self._updates += 1
        self._learned_at[index] = self._updates

    def learned(self, losses: Mapping[str, Tensor]) -> None:
        """Record the last update's losses; ``"td_error"`` is squared."""
        self._squares = losses.get("td_error")

    def add(self, total_steps: int, *, episode: int, buffer: SignalReplayBuffer) -> None:
        """Add a row."""
        rewards = buffer.rewards()
        stats = buffer.stats()
        seen = self._learned_at[: len(rewards)]
        row: dict[str, float] = {
            "total_steps": total_steps,
            "episode": episode,
            "updates": self._updates,
            "reward": self._reward,
            "average_reward": self._reward / max(self._actions, 1),
            "td_error_age_buffer": _mean(self._updates - seen[seen != _NEVER]),
            "positive_buffer": _mean(rewards > 0),
            "phi": stats.get("boost_factor", math.nan),
        }
        if self._squares is not None:
            known = self._before[self._before != _NEVER]
            row |= {
                "td_error": _mean(self._squares.sqrt()) / self._scale,
                # The errors are those from before this update.
                "td_error_age": _mean(self._updates - known),
                "fresh": _mean(self._before == _NEVER),
                "positive_batch": _mean(rewards[self._index] > 0),
            }
        weights = {name: value for name, value in stats.items() if name.startswith("weight/")}
        row |= {name.replace("/", "_"): value for name, value in weights.items()}
        self.rows.append(row)
        self.history.add(total_steps, buffer)
        self._reward, self._actions, self._squares = 0.0, 0, None

    def table(self) -> pd.DataFrame:
        """The rows as a table, the columns of all methods first."""
        import pandas as pd

        found = pd.DataFrame(self.rows)
        own = sorted(set(found.columns) - set(COLUMNS))
        return found.reindex(columns=[*COLUMNS, *own])

    def state_dict(self) -> dict[str, Any]:
        """Return what the next row depends on, and the rows."""
        return {
            "rows": self.rows,
            "history": self.history.state_dict(),
            "learned_at": self._learned_at,
            "last": (self._index, self._before, self._squares),
            "updates": self._updates,
            "reward": self._reward,
            "actions": self._actions,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of :meth:`state_dict`."""
        self.rows = list(state["rows"])
        self.history.load_state_dict(state.get("history", {}))
        self._learned_at, self._updates = state["learned_at"].clone(), state["updates"]
        self._index, self._before, self._squares = state["last"]
        self._reward, self._actions = state["reward"], state["actions"]


def _mean(values: Tensor) -> float:
    """Mean of numbers or flags; NaN of none."""
    return float(values.double().mean())


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
