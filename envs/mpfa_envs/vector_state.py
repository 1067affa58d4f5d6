"""Checks of what a vector environment is restored from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from mpfa_envs.noise import RobotNoise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.arguments import TaskArguments
    from mpfa_envs.lidar import Lidar


def describe(rules: TaskArguments, lidar: Lidar, robots: int) -> dict[str, Any]:
    """Name the arguments that an environment must share with the one that it goes on for.

    Args:
        rules: The arguments of the task.
        lidar: What the robots see by.
        robots: Their number.

    Returns:
        Plain values by name.
    """
    return {
        "num_envs": robots,
        "robot": rules.robot.name,
        "physics": rules.physics,
        "max_steps": rules.max_steps,
        "time_step": rules.time_step,
        "action_repeat": rules.action_repeat,
        "goal_radius": rules.goal_radius,
        "collision_distance": rules.collision_distance,
        "closeness_distance": rules.closeness_distance,
        "progress": rules.progress,
        "memory": rules.memory,
        "history": rules.history,
        # None without, as states had it before there was any.
        "noise": None if rules.noise == RobotNoise() else asdict(rules.noise),
        "rays": lidar.angles.size,
        "sectors": lidar.sectors,
    }


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
    parts = ("arguments", "source", "batch")
    if not isinstance(state, Mapping) or not all(
        isinstance(state.get(part), Mapping) for part in parts
    ):
        raise ValueError(f"state must be what state_dict() gave, with {parts}, got another value")
    found = state["arguments"]
    for name, value in expected.items():
        if found.get(name) != value:
            raise ValueError(
                f"state must be of an environment with {name} = {value!r}, got one with "
                f"{found.get(name)!r}"
            )
    return state


def read_array(state: Mapping[str, Any], name: str, like: NDArray[Any]) -> NDArray[Any]:
    """Read an array of a state.

    Args:
        state: Where it is.
        name: Its name.
        like: An array of the same shape and kind.

    Returns:
        A copy of it.

    Raises:
        ValueError: If it is missing or of another shape.
    """
    values = np.array(state.get(name), dtype=like.dtype if name in state else object)
    if values.shape != like.shape:
        raise ValueError(f"{name} of the state must have shape {like.shape}, got {values.shape}")
    return values


def read_generators(states: object, robots: int) -> list[np.random.Generator]:
    """Make each robot's source of randomness anew.

    Args:
        states: The states of their bit generators.
        robots: Number of robots; there may be none before the first reset.

    Returns:
        The sources.

    Raises:
        ValueError: If there are not as many as robots, or a state is none.
    """
    if not isinstance(states, Sequence) or len(states) not in (0, robots):
        raise ValueError(f"rngs of the state must have {robots} entries, got {states!r}")
    generators = [np.random.default_rng(0) for _ in states]
    for generator, state in zip(generators, states, strict=True):
        try:
            generator.bit_generator.state = state
        except (TypeError, ValueError, KeyError) as error:
            raise ValueError(f"rngs of the state must be of PCG64, got {state!r}") from error
    return generators
