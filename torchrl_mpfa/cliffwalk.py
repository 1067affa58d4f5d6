r"""Blind cliffwalk: the least task in which a replay that finds what matters learns much faster.

Schaul et al. (2016), "Prioritized experience replay", https://arxiv.org/abs/1511.05952, section 3.1
and appendix B.1. In each of ``n`` states one of two actions is right and leads on, the other one
ends the episode with nothing; the right action in the last state ends it with a reward of 1. The
memory holds every one of the :math:`2^n` sequences of actions once, to its end: :math:`2^{n+1} - 2`
transitions, of which a single one has a reward. Q learning replays them one by one until Q is the
true one; what is counted is how many it takes.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer

from torchrl_mpfa.checks import check_counts
from torchrl_mpfa.renamed import OF_CLIFFWALK, find

Features = Literal["tabular", "linear"]
Transition = tuple[int, int, int, float, bool]
"""State, action, next state, reward, and whether the episode ends there."""
_LONGEST = 20


class Cliffwalk:
    r"""The task: transitions of all sequences of actions, and the true values.

    Args:
        length: Number of states ``n``, at least 2.

    Raises:
        ValueError: If the length is no integer from 2 to 20.

    Examples:
        >>> cliff = Cliffwalk(3)
        >>> cliff.size, [round(value, 3) for value in cliff.values]
        (14, [0.444, 0.667, 1.0])
        >>> cliff.transitions()["next", "reward"].sum().item()
        1.0
    """

    def __init__(self, length: int) -> None:
        check_counts(length=length)
        if not 2 <= length <= _LONGEST:
            raise ValueError(f"length must be from 2 to {_LONGEST}, got {length}")
        self.length = length
        self.gamma = 1.0 - 1.0 / length
        r"""Discount :math:`1 - 1/n`, which keeps all values above :math:`1/e`."""
        self.size = 2 ** (length + 1) - 2
        """Number of transitions ``N``."""
        self.right = [state % 2 for state in range(length)]
        """The right action in each state, one and the other in turn."""
        self.values = [self.gamma ** (length - 1 - state) for state in range(length)]
        """True value of the right action in each state; that of the wrong one is 0."""

    def transitions(self, generator: torch.Generator | None = None) -> TensorDict:
        """All transitions, sequence after sequence in random order.

        Args:
            generator: Source of that order; None: PyTorch's own.

        Returns:
            ``state``, ``action`` and ``("next", "state")``, integers of shape ``[N]``, and
            ``("next", "reward")`` and ``("next", "terminated")``, shape ``[N, 1]``.
        """
        n = self.length
        sequence = torch.randperm(2**n, generator=generator).unsqueeze(1)
        action = (sequence >> torch.arange(n)) & 1
        right = action == torch.tensor(self.right)
        # A state is reached when all actions before were right.
        reached = torch.cat([torch.ones(2**n, 1, dtype=torch.long), right.long()[:, :-1]], 1)
        row, state = reached.cumprod(1).nonzero(as_tuple=True)
        right = right[row, state]
        goal = right & (state == n - 1)
        after = {
            "state": (state + 1).clamp_max(n - 1),
            "reward": goal.float().unsqueeze(1),
            "terminated": (goal | ~right).unsqueeze(1),
        }
        return TensorDict(
            {"state": state, "action": action[row, state], "next": after}, [self.size]
        )


class CliffwalkValues:
    r"""Q of every state and action, learned by Q learning at a rate of 1/4.

    Args:
        cliff: The task.
        features: ``"tabular"``, or ``"linear"``: one weight for each state and action and one for
            each action alone, so that what is learned in a state moves the others as well.
        generator: Source of the first values, normal with a standard deviation of 0.1.

    Raises:
        ValueError: If ``features`` is unknown.
    """

    RATE = 0.25

    def __init__(
        self,
        cliff: Cliffwalk,
        *,
        features: Features = "tabular",
        generator: torch.Generator | None = None,
    ) -> None:
        if features not in ("tabular", "linear"):
            raise ValueError(f"features must be 'tabular' or 'linear', got {features!r}")
        n = cliff.length
        self._gamma, self._linear = cliff.gamma, features == "linear"
        first = torch.randn(2, n + 1, generator=generator).mul(0.1)
        values = first[:, :n] + first[:, n:] if self._linear else first[:, :n]
        self.q: list[list[float]] = values.tolist()
        """Q by action and state."""
        pairs = list(zip(cliff.values, cliff.right, strict=True))
        self._truth = [[value * (action == right) for value, right in pairs] for action in (0, 1)]
        self._squares = sum(
            (found - true) ** 2
            for row, truth in zip(self.q, self._truth, strict=True)
            for found, true in zip(row, truth, strict=True)
        )

    @property
    def error(self) -> float:
        """Mean squared difference from the true values."""
        return self._squares / (2 * len(self.q[0]))

    def error_after(self, transition: Transition) -> float:
        """What the error would be after an update by a transition."""
        state, action = transition[:2]
        step = self.RATE * self.td_error(*transition)
        moved = [0.0] * len(self.q[0])
        if self._linear:
            moved = [step] * len(moved)
        moved[state] += step
        row, truth = self.q[action], self._truth[action]
        change = sum(
            by * (2.0 * (found - true) + by)
            for by, found, true in zip(moved, row, truth, strict=True)
        )
        return (self._squares + change) / (2 * len(row))

    def td_error(self, state: int, action: int, after: int, reward: float, end: bool) -> float:
        r"""The TD error :math:`r + \gamma \max_a Q(s', a) - Q(s, a)` of a transition."""
        ahead = 0.0 if end else self._gamma * max(self.q[0][after], self.q[1][after])
        return reward + ahead - self.q[action][state]

    def learn(self, state: int, action: int, after: int, reward: float, end: bool) -> float:
        """Make one update, and give the TD error before it."""
        td_error = self.td_error(state, action, after, reward, end)
        step = self.RATE * td_error
        if self._linear:
            for other in range(len(self.q[0])):
                self._move(action, other, step)
        self._move(action, state, step)
        return td_error

    def _move(self, action: int, state: int, step: float) -> None:
        row, true = self.q[action], self._truth[action][state]
        before = row[state] - true
        row[state] += step
        self._squares += step * (2.0 * before + step)


def updates_to_convergence(
    cliff: Cliffwalk,
    buffer: TensorDictReplayBuffer,
    *,
    features: Features = "tabular",
    threshold: float = 1e-3,
    limit: int | None = None,
    seed: int = 0,
) -> float:
    """Fill an empty buffer with the task and count the updates until Q is the true one.

    After each batch its priorities are updated by the TD errors, as in any training loop. The loss
    has no importance weights: what is measured is which transitions a sampler finds.

    Args:
        cliff: The task.
        buffer: The buffer, with its sampler. Its batch size is how many updates are made before
            priorities are written.
        features: As in :class:`CliffwalkValues`.
        threshold: Mean squared error below which Q is the true one.
        limit: Updates after which to give up; None: a thousand for each transition.
        seed: Seed of the first values and of the order in the memory.

    Returns:
        Number of updates, or infinity where the limit was reached.

    Raises:
        ValueError: If the buffer is not empty or has no batch size.

    Examples:
        >>> from torchrl_mpfa.methods import make_replay
        >>> cliff = Cliffwalk(6)
        >>> replay = make_replay("per", capacity=cliff.size, batch_size=1, eps=1e-3)
        >>> updates_to_convergence(cliff, replay.buffer) < 2_000
        True
    """
    if len(buffer) or buffer.batch_size is None:
        raise ValueError(
            f"buffer must be empty and have a batch_size, got {len(buffer)} transitions and "
            f"{buffer.batch_size}"
        )
    generator = torch.Generator().manual_seed(seed)
    buffer.extend(cliff.transitions(generator))
    values = CliffwalkValues(cliff, features=features, generator=generator)
    limit = 1000 * cliff.size if limit is None else limit
    updates = 0
    while updates < limit:
        batch = buffer.sample()
        after = batch["next"]
        found = []
        for transition in zip(
            batch["state"].tolist(),
            batch["action"].tolist(),
            after["state"].tolist(),
            after["reward"].squeeze(1).tolist(),
            after["terminated"].squeeze(1).tolist(),
            strict=True,
        ):
            found.append(abs(values.learn(*transition)))
            updates += 1
            if values.error < threshold:
                return updates
        batch["signals", "td_error"] = torch.tensor(found)
        buffer.update_tensordict_priority(batch)
    return math.inf


def __getattr__(name: str) -> Any:
    """Tell where names are that serve the study alone."""
    return find(__name__, name, OF_CLIFFWALK)
