"""The navigation task as a TorchRL environment."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, EnvCreator, ParallelEnv

from mpfa_envs.checks import check_count
from mpfa_envs.navigation import NavigationEnv
from mpfa_envs.observation import INFO_TYPES, observation_bounds

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Sequence

    from torchrl.data import TensorSpec

    from mpfa_envs.worlds import World


class NavigationTorchEnv(EnvBase):
    """One or several :class:`~mpfa_envs.NavigationEnv` behind TorchRL's interface.

    It speaks TensorDict itself instead of wrapping each environment, so the cost of a TensorDict is
    paid once a step, not once an environment.

    ============================ ========= =============================================
    key                          shape     meaning
    ============================ ========= =============================================
    ``"observation"``            ``[24]``  float32, as :class:`~mpfa_envs.NavigationEnv`
    ``"action"``                 ``[2]``   float32 in [-1, 1]
    ``"reward"``                 ``[1]``   float32
    ``"done"``, ``"terminated"`` ``[1]``   bool
    and ``"truncated"``
    ``("info", name)``           ``[1]``   every entry of
                                           :data:`~mpfa_envs.INFO_TYPES`, bool or float32
    ============================ ========= =============================================

    All shapes follow the batch size: ``[]`` for one environment, else ``[num_envs]``.

    Args:
        num_envs: Number of environments in this process; None: one, without a batch dimension.
        device: Where the tensors live; the simulation runs on the CPU.
        info_keys: Which entries of the info to pass on; None: all. Each costs TorchRL some 20 µs a
            step, which is more than it costs to compute.
        **kwargs: Arguments of :class:`~mpfa_envs.NavigationEnv`.

    Raises:
        ValueError: If num_envs is not a positive integer, or an argument is out of its range.

    Examples:
        >>> from mpfa_envs import NavigationTorchEnv
        >>> env = NavigationTorchEnv(num_envs=2, world="B", physics="kinematic")
        >>> env.rollout(5)["next", "info", "distance"].shape
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
        **kwargs: Any,
    ) -> None:
        _check_num_envs(num_envs)
        keys = list(INFO_TYPES if info_keys is None else info_keys)
        for key in keys:
            if key not in INFO_TYPES:
                raise ValueError(f"info_keys must be among {list(INFO_TYPES)}, got {key!r}")
        batch_size = torch.Size([] if num_envs is None else [num_envs])
        super().__init__(device=device, batch_size=batch_size)
        self.envs = [NavigationEnv(**kwargs) for _ in range(num_envs or 1)]
        """The environments, in the order of the batch."""
        self._seeds: list[int | None] = [None] * len(self.envs)
        self._tasks: list[dict[str, Any] | None] = [None] * len(self.envs)
        self._observations = np.zeros(
            (len(self.envs), self.envs[0].lidar.sectors + 6), dtype=np.float32
        )
        self._number_names = [name for name in keys if INFO_TYPES[name] is float]
        self._flag_names = [name for name in keys if INFO_TYPES[name] is bool]
        self._numbers: list[list[float]] = [[] for _ in self.envs]
        self._flags: list[list[bool]] = [[] for _ in self.envs]
        self._make_specs()

    def _make_specs(self) -> None:
        env = self.envs[0]
        one = (*self.batch_size, 1)
        low, high = (
            torch.as_tensor(bound).expand((*self.batch_size, -1)).contiguous()
            for bound in observation_bounds(env.lidar.sectors, env.world.diagonal)
        )
        entries: dict[str, TensorSpec] = {
            name: Binary(shape=one, dtype=torch.bool) for name in self._flag_names
        }
        entries.update(
            {name: Unbounded(shape=one, dtype=torch.float32) for name in self._number_names}
        )
        self.observation_spec = Composite(
            observation=Bounded(low=low, high=high, dtype=torch.float32), shape=self.batch_size
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
    ) -> None:
        """Fix the start and the goal of the next episode, and of no later one.

        Args:
            start: Pose (x, y, heading) [m, m, rad].
            goal: Position (x, y) [m].
            index: Which environment of the batch.

        Raises:
            IndexError: If there is no such environment.
            ValueError: If the task cannot be driven.
        """
        if not 0 <= index < len(self.envs):
            raise IndexError(f"index must be in [0, {len(self.envs)}), got {index}")
        options = {"start": start, "goal": goal}
        self.envs[index].check_task(options)
        self._tasks[index] = options

    def _set_seed(self, seed: int | None) -> None:
        self._seeds = [None if seed is None else seed + i for i in range(len(self.envs))]

    def _keep(self, index: int, observation: np.ndarray[Any, Any], info: dict[str, Any]) -> None:
        self._observations[index] = observation
        self._numbers[index] = [info[name] for name in self._number_names]
        self._flags[index] = [info[name] for name in self._flag_names]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        chosen = [True] * len(self.envs) if mask is None else mask.reshape(-1).tolist()
        for index, env in enumerate(self.envs):
            if not chosen[index]:
                continue
            seed, task = self._seeds[index], self._tasks[index]
            self._seeds[index] = self._tasks[index] = None
            self._keep(index, *env.reset(seed=seed, options=task))
        return self._pack()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict.get("action").detach().cpu().numpy().reshape(len(self.envs), 2)
        # A rollout that waits for the last episode of a batch masks those that are over.
        mask = tensordict.get("_step", None)
        chosen = [True] * len(self.envs) if mask is None else mask.reshape(-1).tolist()
        rewards = [0.0] * len(self.envs)
        ends = [(False, False)] * len(self.envs)
        for index, env in enumerate(self.envs):
            if chosen[index]:
                observation, rewards[index], terminated, truncated, info = env.step(actions[index])
                self._keep(index, observation, info)
                ends[index] = terminated, truncated
        return self._pack(rewards, ends)

    def _pack(
        self, rewards: list[float] | None = None, ends: list[tuple[bool, bool]] | None = None
    ) -> TensorDictBase:
        """Build what a reset gives, or with rewards and (terminated, truncated) what a step gives.

        Few tensors are made and then cut, as making one costs more than all that is done with it.
        """
        names, flags = self._number_names, self._flag_names
        numbers, bits = self._numbers, self._flags
        if rewards is not None and ends is not None:
            numbers = [[*row, reward] for row, reward in zip(numbers, rewards, strict=True)]
            bits = [[*row, *end, any(end)] for row, end in zip(bits, ends, strict=True)]
        columns = self._columns(numbers, torch.float32)
        bit_columns = self._columns(bits, torch.bool)
        # A copy: what a rollout has collected must not change with the next step.
        observation = torch.tensor(self._observations, device=self.device)
        entries: dict[str, Any] = {"observation": observation.view(*self.batch_size, -1)}
        if names or flags:
            info = dict(zip(names, columns, strict=False))
            info.update(zip(flags, bit_columns, strict=False))
            entries["info"] = TensorDict(info, batch_size=self.batch_size, device=self.device)
        if rewards is not None:
            entries["reward"] = columns[-1]
            entries["terminated"], entries["truncated"], entries["done"] = bit_columns[-3:]
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def _columns(
        self, rows: list[list[float]] | list[list[bool]], dtype: torch.dtype
    ) -> tuple[torch.Tensor, ...]:
        """Turn one row per environment into tensors of shape ``[*batch, 1]``, one per column."""
        table = torch.tensor(rows, dtype=dtype, device=self.device)
        return table.view(*self.batch_size, -1, 1).unbind(-2) if table.numel() else ()

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Release the physics servers; a second call does nothing.

        Args:
            raise_if_closed: Accepted for TorchRL's sake.
        """
        for env in self.envs:
            env.close()
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)


def make_navigation_env(
    world: str | os.PathLike[str] | World = "A",
    *,
    num_envs: int | None = None,
    parallel: bool = False,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **kwargs: Any,
) -> EnvBase:
    """Build the navigation task for TorchRL.

    Args:
        world: As in :class:`~mpfa_envs.NavigationEnv`.
        num_envs: Number of environments; None: one, without a batch dimension.
        parallel: Run each environment in a process of its own.
        device: Where the tensors live.
        seed: Seed of the environments; None leaves them to chance.
        **kwargs: Further arguments of :class:`~mpfa_envs.NavigationEnv`.

    Returns:
        A :class:`NavigationTorchEnv`, or a ``ParallelEnv`` of them, of batch size ``[num_envs]`` or
        ``[]``.

    Raises:
        ValueError: If num_envs is not a positive integer, parallel environments have no number, or
            another argument is out of its range.

    Examples:
        >>> from mpfa_envs import make_navigation_env
        >>> env = make_navigation_env("C", physics="kinematic", seed=0)
        >>> rollout = env.rollout(3)
        >>> rollout["observation"].shape, rollout["next", "info", "success"].shape
        (torch.Size([3, 24]), torch.Size([3, 1]))
        >>> env.close()
    """
    _check_num_envs(num_envs)
    if parallel:
        if num_envs is None:
            raise ValueError("num_envs must be a positive integer with parallel=True, got None")
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


def _check_num_envs(num_envs: int | None) -> None:
    if num_envs is not None:
        check_count("num_envs", num_envs)
