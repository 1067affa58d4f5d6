"""The environments of a run: where it learns, and what a policy must sense where it is judged."""

from __future__ import annotations

from typing import Any

from torchrl.envs import EnvBase

from mpfa_envs import make_navigation_env
from mpfa_envs.robot import resolve_robot
from navigation.settings import EnvironmentSettings

INFO = ("success", "collision", "timeout", "path_length", "shortest_path")


def env_arguments(settings: EnvironmentSettings) -> dict[str, Any]:
    """What a policy must find again wherever it drives: robot, time, and lidar.

    Args:
        settings: The environment's settings in training.

    Returns:
        Arguments of :class:`mpfa_envs.NavigationEnv`.
    """
    return {
        "robot": settings.robot,
        "physics": settings.physics,
        "max_steps": settings.max_steps,
        "action_repeat": settings.action_repeat,
        # The lidar saturates where the training ends an episode, and tells all distances above.
        "closeness_distance": collision_distance(settings),
    }


def collision_distance(settings: EnvironmentSettings) -> float:
    """Distance of the robot's center from an obstacle that training counts as a collision [m]."""
    return resolve_robot(settings.robot).radius + settings.clearance


def make_training_env(world: str, settings: EnvironmentSettings) -> EnvBase:
    """The environment to learn in.

    Args:
        world: Name of a world, or a world file.
        settings: The environment's settings.

    Returns:
        The environment, with the entries of ``info`` that a run records.
    """
    return make_navigation_env(
        world,
        info_keys=INFO,
        collision_distance=collision_distance(settings),
        progress_scale=settings.progress_scale,
        detour_chance=settings.detour_chance,
        **env_arguments(settings),
    )
