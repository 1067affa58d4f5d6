"""The navigation task as a TorchRL environment."""

from __future__ import annotations

import warnings
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, EnvCreator, ParallelEnv

from mpfa_envs.checks import check_count
from mpfa_envs.env.vector import VectorNavigationEnv
from mpfa_envs.sensing.observation import FLAGS, INFO_TYPES, NUMBERS

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray
    from torchrl.data import TensorSpec

    from mpfa_envs.env.episodes import WorldChoice
    from mpfa_envs.worlds.world import Task, World


class NavigationTorchEnv(EnvBase):
    """Many robots, or one, behind TorchRL's interface: a :class:`~mpfa_envs.VectorNavigationEnv`.

    ============================ ========= =============================================
    key                          shape     meaning
    ============================ ========= =============================================
    ``"observation"``            ``[24]``  float32, as :class:`~mpfa_envs.NavigationEnv`
    ``"action"``                 ``[2]``   float32 in [-1, 1]
    ``"reward"``                 ``[1]``   float32
    ``"done"``, ``"terminated"`` ``[1]``   bool
    and ``"truncated"``
    ``("info", name)``           ``[1]``   every entry of
                                           ``INFO_TYPES``, bool or float32
    ``"hindsight"``              ``[M]``   float64, with ``hindsight=True``:
                                           what a goal in hindsight needs,
                                           :attr:`VectorNavigationEnv.measurements`
    ============================ ========= =============================================

    All shapes follow the batch size: ``[]`` for one robot, else ``[num_envs]``. ``reset(seed=3)``
    seeds the robots that it starts, as ``set_seed(3)`` seeds all.

    Args:
        num_envs: Number of robots in this process; None: one, without a batch dimension, which has
            the episodes of a :class:`~mpfa_envs.NavigationEnv` of the same seed.
        device: Where the tensors live; the simulation runs on the CPU.
        info_keys: Which entries of the info to pass on; None: all. Each costs TorchRL some 20 µs a
            step, which is more than it costs to compute.
        hindsight: If True, add ``"hindsight"``, for :class:`~mpfa_envs.GoalRelabeling`.
        **kwargs: Arguments of :class:`~mpfa_envs.VectorNavigationEnv`.

    Raises:
        ValueError: If num_envs is not a positive integer, or an argument is out of its range.

    Examples:
        >>> from mpfa_envs import NavigationTorchEnv
        >>> env = NavigationTorchEnv(num_envs=2, world="B", physics="kinematic")
        >>> env.rollout(5, break_when_any_done=False)["next", "info", "distance"].shape
        torch.Size([2, 5, 1])
        >>> env.close()

    See Also:
        :func:`make_navigation_env`, which also runs environments in processes of their own.
    """

    def __init__(
        self,
        *,
        num_envs: int | None = None,
        device: torch.device | str | None = None,
        info_keys: Iterable[str] | None = None,
        hindsight: bool = False,
        **kwargs: Any,
    ) -> None:
        keys = list(INFO_TYPES if info_keys is None else info_keys)
        for key in keys:
            if key not in INFO_TYPES:
                raise ValueError(f"info_keys must be among {list(INFO_TYPES)}, got {key!r}")
        robots = 1 if num_envs is None else num_envs
        env = VectorNavigationEnv(robots, autoreset_mode=AutoresetMode.DISABLED, **kwargs)
        batch_size = torch.Size([] if num_envs is None else [env.num_envs])
        super().__init__(device=device, batch_size=batch_size)
        self.env = env
        """The robots in the order of the batch."""
        self._hindsight = hindsight
        self._flags, self._numbers = (
            {name: row for row, name in enumerate(names) if name in keys}
            for names in (FLAGS, NUMBERS)
        )
        self._worlds: list[World | None] = [None] * env.num_envs
        self._tasks: list[Task | None] = [None] * env.num_envs
        self._make_specs()

    def _make_specs(self) -> None:
        one = (*self.batch_size, 1)
        space = self.env.single_observation_space
        low, high = (
            torch.as_tensor(bound).expand((*self.batch_size, -1)).contiguous()
            for bound in (space.low, space.high)
        )
        entries: dict[str, TensorSpec] = {
            name: Binary(shape=one, dtype=torch.bool) for name in self._flags
        }
        entries.update({name: Unbounded(shape=one, dtype=torch.float32) for name in self._numbers})
        self.observation_spec = Composite(
            observation=Bounded(low=low, high=high, dtype=torch.float32), shape=self.batch_size
        )
        if self._hindsight:
            self.observation_spec["hindsight"] = Unbounded(
                shape=(*self.batch_size, self.env.lidar.angles.size + 12), dtype=torch.float64
            )
        if entries:
            self.observation_spec["info"] = Composite(entries, shape=self.batch_size)
        self.action_spec = Bounded(
            low=-1.0, high=1.0, shape=(*self.batch_size, 2), dtype=torch.float32
        )
        self.reward_spec = Unbounded(shape=one, dtype=torch.float32)
        self.done_spec = Composite(
            {
                name: Binary(shape=one, dtype=torch.bool)
                for name in ("done", "terminated", "truncated")
            },
            shape=self.batch_size,
        )

    def set_task(
        self,
        start: Sequence[float],
        goal: Sequence[float],
        *,
        index: int = 0,
        world: str | os.PathLike[str] | World | None = None,
    ) -> None:
        """Fix the start and the goal of a robot's next episode, and of no later one.

        Args:
            start: Pose (x, y, heading) [m, m, rad].
            goal: Position (x, y) [m].
            index: Which robot of the batch.
            world: That of the episode; None: the one that the robot always drives in.

        Raises:
            IndexError: If there is no such robot.
            ValueError: If the task cannot be driven.
        """
        if not 0 <= index < self.env.num_envs:
            raise IndexError(f"index must be in [0, {self.env.num_envs}), got {index}")
        self._worlds[index], self._tasks[index] = self.env.check_task(index, start, goal, world)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.env.set_seed(self._seed_of_robots(seed))

    def _seed_of_robots(self, seed: int) -> int | list[int]:
        """One robot without a batch dimension has the seed itself, as a NavigationEnv."""
        return seed if self.batch_size else [seed]

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Load a state of TorchRL's, which holds nothing of the robots, and warn if ``strict``.

        TorchRL's creators and collectors pass such states on without the observations that belong
        to them. The state of the robots is that of :attr:`env`.
        """
        if strict:
            warnings.warn(
                "a state_dict of TorchRL holds nothing of the robots, which stay where they are: "
                "save env.env.state_dict(), and load it with env.env.load_state_dict(state)",
                stacklevel=2,
            )
        return super().load_state_dict(state_dict, strict=strict, assign=assign)

    def _mask(self, tensordict: TensorDictBase | None, key: str) -> NDArray[np.bool_] | None:
        """Robots that an entry of the input names; None: all."""
        mask = None if tensordict is None else tensordict.get(key, None)
        return None if mask is None else mask.reshape(-1).cpu().numpy()

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | None = None
    ) -> TensorDictBase:
        mask = self._mask(tensordict, "_reset")
        chosen = np.ones(self.env.num_envs, dtype=np.bool_) if mask is None else mask
        if chosen.any():
            worlds, tasks = (
                [one if wanted else None for one, wanted in zip(ones, chosen, strict=True)]
                for ones in (self._worlds, self._tasks)
            )
            options = {"reset_mask": chosen, "worlds": worlds, "tasks": tasks}
            observations, _ = self.env.reset(
                seed=None if seed is None else self._seed_of_robots(seed), options=options
            )
            for index in np.flatnonzero(chosen).tolist():
                self._worlds[index] = self._tasks[index] = None
        else:
            observations = self.env.observations
        return self._pack(observations)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict.get("action").detach().cpu().numpy()
        if actions.shape != (*self.batch_size, 2):
            raise ValueError(
                f"action must have shape {[*self.batch_size, 2]}, got {[*actions.shape]}"
            )
        # A rollout that waits for the last episode of a batch masks the ended ones.
        observations, rewards, terminated, truncated, _ = self.env.step(
            actions.reshape(self.env.num_envs, 2), only=self._mask(tensordict, "_step")
        )
        return self._pack(
            observations,
            reward=self._tensor(rewards.astype(np.float32)),
            terminated=self._tensor(terminated),
            truncated=self._tensor(truncated),
            done=self._tensor(terminated | truncated),
        )

    def _pack(self, observations: NDArray[np.float32], **entries: torch.Tensor) -> TensorDictBase:
        """Build the output of a reset, or with further entries of a step."""
        shape = (*self.batch_size, observations.shape[1])
        rows: dict[str, Any] = {"observation": self._to_device(observations).view(shape), **entries}
        if self._hindsight:
            rows["hindsight"] = self._to_device(self.env.measurements).view(*self.batch_size, -1)
        if self._numbers or self._flags:
            flags, numbers = self.env.info_tables
            # Two tensors, split into entries: creating a tensor costs more than anything else here.
            numbers = numbers[list(self._numbers.values())].astype(np.float32)
            info = dict(zip(self._numbers, self._tensor(numbers).unbind(), strict=True))
            flags = flags[list(self._flags.values())]
            info.update(zip(self._flags, self._tensor(flags).unbind(), strict=True))
            rows["info"] = TensorDict(info, batch_size=self.batch_size, device=self.device)
        return TensorDict(rows, batch_size=self.batch_size, device=self.device)

    def _tensor(self, values: NDArray[Any]) -> torch.Tensor:
        """A tensor of shape ``[..., *batch, 1]`` of an array ``[..., N]``."""
        return self._to_device(values).view(*values.shape[:-1], *self.batch_size, 1)

    def _to_device(self, values: NDArray[Any]) -> torch.Tensor:
        tensor = torch.from_numpy(values)
        return tensor if self.device is None else tensor.to(self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Release the physics servers; a second call does nothing."""
        self.env.close()
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)


def make_navigation_env(
    world: WorldChoice | Sequence[WorldChoice] = "A",
    *,
    num_envs: int | None = None,
    parallel: bool = False,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **kwargs: Any,
) -> EnvBase:
    """Build the navigation task for TorchRL.

    Args:
        world: A world, several, or the name of a generator.
        num_envs: Number of robots; None: one, without a batch dimension.
        parallel: Run each robot in a process of its own, all in one world or in the worlds of one
            generator.
        device: Where the tensors live.
        seed: Seed of the environments; None: random.
        **kwargs: Further arguments of :class:`~mpfa_envs.VectorNavigationEnv`.

    Returns:
        A :class:`NavigationTorchEnv`, or a ``ParallelEnv`` of them, of batch size ``[num_envs]`` or
        ``[]``.

    Raises:
        ValueError: If num_envs is not a positive integer, parallel environments have no number or
            several worlds, or another argument is out of its range.

    Examples:
        >>> from mpfa_envs import make_navigation_env
        >>> env = make_navigation_env("C", physics="kinematic", seed=0)
        >>> rollout = env.rollout(3)
        >>> rollout["observation"].shape, rollout["next", "info", "success"].shape
        (torch.Size([3, 24]), torch.Size([3, 1]))
        >>> env.close()
    """
    if parallel:
        if num_envs is None:
            raise ValueError("num_envs must be a positive integer with parallel=True, got None")
        check_count("num_envs", num_envs)
        if isinstance(world, list | tuple) and len(world) > 1:
            raise ValueError(
                f"world must be one, or the name of a generator, with parallel=True, got {world}"
            )
        env: EnvBase = ParallelEnv(
            num_envs,
            EnvCreator(partial(NavigationTorchEnv, world=world, **kwargs)),
            device=device,
        )
    else:
        env = NavigationTorchEnv(num_envs=num_envs, device=device, world=world, **kwargs)
    if seed is not None:
        env.set_seed(seed)
    return env
