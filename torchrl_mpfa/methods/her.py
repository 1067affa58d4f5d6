"""Hindsight experience replay: episodes are learned from again, with goals that they reached.

After Andrychowicz et al. (2017), "Hindsight experience replay", https://arxiv.org/abs/1707.01495.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Transform

from torchrl_mpfa.checks import as_mask, check_counts
from torchrl_mpfa.episodes import episodes_of
from torchrl_mpfa.saving import check_saved


class Relabel(Protocol):
    """Gives an episode other goals."""

    @property
    def entries(self) -> tuple[NestedKey, ...]:
        """Extra entries to read, which are not stored."""
        ...

    def __call__(self, episode: TensorDictBase, steps: Tensor) -> TensorDictBase:
        """Relabel an episode, once for each of some goals.

        Args:
            episode: Its transitions in their order, batch size ``[T]``.
            steps: Numbers of the steps after which the goals were reached, ``[K]``.

        Returns:
            Transitions, batch size ``[R]``, with the entries that are stored.
        """
        ...


GOALS_FOR = "episode", "transition"
"""What a goal in hindsight may be chosen for."""


class GymnasiumGoals:
    """Gives an episode of a goal task of Gymnasium goals that it reached; the task itself pays.

    Observations end with the goal, as ``CatTensors(["observation", "desired_goal"])`` of TorchRL
    makes them. What the task calls ``achieved_goal`` after each step is read, and not stored.

    Args:
        compute_reward: That of the task: from goals that were achieved and wanted, ``[R, G]`` each,
            and an empty mapping, to rewards, ``[R]``.
        goals_for: ``"episode"``: a goal is that of all steps before it. ``"transition"``: each
            transition has as many goals of its own, reached after it or later, as published; no
            more than the episode has steps.
        generator: Source of the choice of goals for transitions, of which the generator of
            :class:`HindsightGoals` knows nothing; None: PyTorch's own.

    Raises:
        ValueError: If ``goals_for`` is neither.

    Examples:
        >>> import numpy as np
        >>> relabel = GymnasiumGoals(lambda achieved, wanted, info: (achieved == wanted)[:, 0])
        >>> place = torch.tensor([[1.0], [2.0]])
        >>> seen = torch.cat((place - 1.0, torch.full((2, 1), 9.0)), -1)
        >>> after = {
        ...     "observation": torch.cat((place, torch.full((2, 1), 9.0)), -1),
        ...     "achieved_goal": place,
        ...     "reward": torch.zeros(2, 1),
        ...     "terminated": torch.zeros(2, 1, dtype=torch.bool),
        ... }
        >>> rows = relabel(TensorDict({"observation": seen, "next": after}, [2]), torch.tensor([1]))
        >>> rows["observation"].tolist(), rows["next", "reward"].flatten().tolist()
        ([[0.0, 2.0], [1.0, 2.0]], [0.0, 1.0])
    """

    entries: ClassVar[tuple[NestedKey, ...]] = (("next", "achieved_goal"),)
    """Entries that it reads, other than observation, reward and ends; its rows lack them."""

    def __init__(
        self,
        compute_reward: Callable[[Any, Any, dict[str, Any]], Any],
        *,
        goals_for: str = "episode",
        generator: torch.Generator | None = None,
    ) -> None:
        if goals_for not in GOALS_FOR:
            raise ValueError(f"goals_for must be one of {', '.join(GOALS_FOR)}, got {goals_for!r}")
        self._compute_reward, self._goals_for = compute_reward, goals_for
        self._generator = generator

    def __call__(self, episode: TensorDictBase, steps: Tensor) -> TensorDictBase:
        """Relabel an episode.

        Args:
            episode: Its transitions in their order, batch size ``[T]``.
            steps: Numbers of the steps after which the goals were reached, ``[K]``; for goals of
                transitions only how many these are.

        Returns:
            The transitions before each of these steps and that of the step itself, ``[R]``; or
            all transitions, ``K`` times each.

        Raises:
            ValueError: If the episode was terminated: whether another goal would have ended it is
                not known.
        """
        if episode["next", "terminated"].any():
            raise ValueError(
                "terminated of a goal task must be False at all steps, got True: let the task go "
                "on at its goal (continuing_task=True in gymnasium-robotics' mazes)"
            )
        achieved = episode["next", "achieved_goal"]
        if self._goals_for == "transition":
            length = len(achieved)
            chosen = torch.arange(length).repeat_interleave(len(steps))
            ahead = torch.rand(len(chosen), generator=self._generator) * (length - chosen)
            reached = chosen + ahead.long()
        else:
            chosen = torch.cat([torch.arange(step + 1) for step in steps.tolist()])
            reached = steps.repeat_interleave(steps + 1)
        goals = achieved[reached]
        rows = episode.exclude(*self.entries)[chosen]
        for key in ("observation", ("next", "observation")):
            rows[key][..., -goals.shape[-1] :] = goals
        here, there = achieved[chosen].cpu().numpy(), goals.cpu().numpy()
        paid = torch.as_tensor(self._compute_reward(here, there, {}))
        reward = rows["next", "reward"]
        rows["next", "reward"] = paid.to(reward).reshape(reward.shape)
        return rows


def future_goals(length: int, goals: int, generator: torch.Generator | None = None) -> Tensor:
    """Choose steps of an episode at random, each at most once.

    Args:
        length: Steps of the episode ``T``.
        goals: Number of steps; of a shorter episode all.
        generator: Source of the choice; None: PyTorch's own.

    Returns:
        Numbers of the steps, at most ``[goals]``.

    Examples:
        >>> future_goals(3, 4).sort().values
        tensor([0, 1, 2])
    """
    return torch.randperm(length, generator=generator, device="cpu")[:goals]


class HindsightGoals(Transform):
    """Writes each episode that has ended to a replay buffer again, for other goals.

    Append it to a buffer: transitions are stored unchanged, and once an episode has ended, its
    relabelled transitions follow in the same call. They are transitions like all others, with
    signals and priorities of their own. Nothing changes when batches are sampled.

    Transitions must have the number of their episode and the entries of ``relabel``; neither is
    stored.
    Unfinished episodes are part of the state of the buffer.

    Args:
        relabel: Gives an episode other goals, say ``mpfa_envs.GoalRelabeling``.
        goals: Goals of an episode ``K``: places reached after steps at random, each the goal of all
            steps before it, unless ``relabel`` chooses goals of its own.
        episode_key: Key of the episode's number, ``[..., 1]``.
        generator: Source of the choice of goals; None: PyTorch's own. Its state is not part of the
            buffer's.

    Raises:
        ValueError: If ``goals`` is not a positive integer.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> class ReachPlace:
        ...     entries = ("place",)
        ...
        ...     def __call__(self, episode, steps):
        ...         goals = episode["place"][steps]
        ...         rows = [episode[: step + 1].clone() for step in steps]
        ...         for steps, goal in zip(rows, goals):
        ...             steps["goal"] = goal.expand(len(steps), 1)
        ...         return torch.cat(rows).exclude("place")
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100))
        >>> goals = HindsightGoals(ReachPlace(), goals=3)
        >>> buffer = buffer.append_transform(goals)
        >>> episode = TensorDict(
        ...     {
        ...         "episode": torch.zeros(3, 1, dtype=torch.long),
        ...         "place": torch.tensor([[1.0], [2.0], [3.0]]),
        ...         "goal": torch.full((3, 1), 9.0),
        ...         "next": {"done": torch.tensor([[False], [False], [True]])},
        ...     },
        ...     [3],
        ... )
        >>> index = buffer.extend(episode)
        >>> buffer[:]["goal"].flatten().sort().values
        tensor([1., 2., 2., 3., 3., 3., 9., 9., 9.])
    """

    def __init__(
        self,
        relabel: Relabel,
        *,
        goals: int = 4,
        episode_key: str = "episode",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.goals, self.generator = check_counts(goals=goals), generator
        self._relabel, self._episode_key = relabel, episode_key
        # Never written in place, and for that reason a tuple.
        self._pending: tuple[TensorDictBase, ...] = ()

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the steps of unfinished episodes, as part of the state of the buffer."""
        if not self._pending:
            return {}
        return dict(cast(TensorDictBase, torch.cat(self._pending)).items(True, True))

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restore the steps of unfinished episodes.

        Numbers that are not finite are rejected by the buffer, which knows where they may be.

        Raises:
            ValueError: If the state is no mapping.
        """
        check_saved("unfinished episodes", state)
        steps = {key: value.clone() for key, value in state.items()}
        count = len(next(iter(steps.values()))) if steps else 0
        self._pending = (TensorDict(steps, [count]),) if steps else ()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leave a sampled batch as it is."""
        return tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        extra = (self._episode_key, *self._relabel.entries)
        for key in extra:
            if tensordict.get(key, None) is None:
                raise KeyError(f"transitions for goals in hindsight must have {key!r}")
        rows = tensordict.reshape(-1)
        done = as_mask("('next', 'done')", rows["next", "done"]).reshape(-1)
        self._pending = (*self._pending, rows.clone())
        written = [rows.exclude(*extra)]
        if done.any():
            written += [self._in_hindsight(episode) for episode in self._take()]
        return torch.cat(written)

    def _take(self) -> list[TensorDictBase]:
        """Remove the episodes that have ended from the pending rows, and return them."""
        rows = cast(TensorDictBase, torch.cat(self._pending))
        number, done = (
            rows[key].reshape(-1).cpu() for key in (self._episode_key, ("next", "done"))
        )
        done = done.bool()
        mine = torch.isin(number, number[done]).nonzero().squeeze(1)
        episode = torch.full((len(rows),), -1, device="cpu")
        episode[mine] = episodes_of(rows, mine, number[mine], done[mine])
        ended = episode[done]
        self._pending = (rows[~torch.isin(episode, ended)],)
        return [rows[episode == number] for number in ended.tolist()]

    def _in_hindsight(self, episode: TensorDictBase) -> TensorDictBase:
        steps = future_goals(len(episode), self.goals, self.generator)
        return self._relabel(episode.exclude(self._episode_key), steps)
