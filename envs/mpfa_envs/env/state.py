"""Checks of what a vector environment is restored from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.robots.model import RobotModel
from mpfa_envs.robots.noise import RobotNoise
from mpfa_envs.tasks.reward import payments_of

if TYPE_CHECKING:
    from mpfa_envs.env.episodes import EpisodeSource
    from mpfa_envs.env.vector import VectorNavigationEnv
    from mpfa_envs.tasks.reward import RewardFunction

_OF_THE_ROBOT: Final = tuple(field.name for field in fields(RobotModel) if field.name != "name")
_OF_THE_LIDAR: Final = ("reduction", "max_range", "noise", "field_of_view", "dropout")


def describe(env: VectorNavigationEnv, source: EpisodeSource) -> dict[str, Any]:
    """Name the arguments that an environment must share with the one that it goes on for.

    Args:
        env: The environment.
        source: Where its episodes come from.

    Returns:
        Plain values by name: whatever decides what happens next.
    """
    lidar, task = env.lidar, env.config
    return {
        "num_envs": env.num_envs,
        "robot": task.robot.name,
        **{f"robot.{name}": float(getattr(task.robot, name)) for name in _OF_THE_ROBOT},
        "physics": task.physics,
        "max_steps": task.max_steps,
        "time_step": task.time_step,
        "action_repeat": task.action_repeat,
        "goal_radius": task.goal_radius,
        "collision_distance": task.collision_distance,
        "closeness_distance": task.closeness_distance,
        "progress": task.progress,
        **_describe_reward(task.reward_function),
        "memory": task.memory,
        "history": task.history,
        # None without, as states had it before there was any.
        "noise": None if task.noise == RobotNoise() else asdict(task.noise),
        "rays": lidar.angles.size,
        "sectors": lidar.sectors,
        **{f"lidar.{name}": getattr(lidar, name) for name in _OF_THE_LIDAR},
        "min_goal_distance": task.min_goal_distance,
        "detour_chance": task.detour_chance,
        **source.describe(),
        "autoreset_mode": env.autoreset_mode.value,
    }


def _describe_reward(reward: RewardFunction) -> dict[str, Any]:
    """What can be compared of a reward: what Eq. (25) pays, and of another one that it is that."""
    payments = payments_of(reward)
    if payments is None:
        return {"reward": "a function of your own"}
    names = ("goal_reward", "collision_reward", "progress_scale")
    return {"reward": "navigation_reward", **dict(zip(names, payments, strict=True))}


def check_alike(state: object, expected: Mapping[str, Any]) -> Mapping[str, Any]:
    """Refuse a state of an environment with other arguments.

    Args:
        state: What is to be loaded.
        expected: What :func:`describe` says of the environment that loads it.

    Returns:
        The state.

    Raises:
        ValueError: If it is no state, or an argument differs.
    """
    parts = {"arguments": Mapping, "source": Mapping, "batch": Mapping, "begun": bool}
    if not isinstance(state, Mapping) or not all(
        isinstance(state.get(part), kind) for part, kind in parts.items()
    ):
        raise ValueError(
            f"state must be what state_dict() gave, with {tuple(parts)}, got another value"
        )
    found = state["arguments"]
    for name, value in expected.items():
        # States did not always describe all of them.
        if name in found and found[name] != value:
            raise ValueError(
                f"state must be of an environment with {name} = {value!r}, got one with "
                f"{found[name]!r}"
            )
    return state


def read_generators(states: object, robots: int, *, begun: bool) -> list[np.random.Generator]:
    """Make each robot's source of randomness anew.

    Args:
        states: The states of their bit generators.
        robots: Number of robots.
        begun: Whether there was a reset; before, there may be none.

    Returns:
        The sources.

    Raises:
        ValueError: If there are not as many as robots, or a state is none.
    """
    counts = (robots,) if begun else (0, robots)
    if not isinstance(states, Sequence) or len(states) not in counts:
        raise ValueError(f"rngs of the state must have {robots} entries, got {states!r}")
    generators = [np.random.default_rng(0) for _ in states]
    for generator, state in zip(generators, states, strict=True):
        try:
            generator.bit_generator.state = state
        except (TypeError, ValueError, KeyError, OverflowError) as error:
            raise ValueError(f"rngs of the state must be of PCG64, got {state!r}") from error
    return generators
