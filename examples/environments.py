"""The environments of a run: where it learns, and where it is judged."""

from __future__ import annotations

from typing import Any, Literal

from torchrl.envs import EnvBase

from mpfa_envs import NavigationEnv, make_navigation_env
from mpfa_envs.robot import resolve_robot
from settings import Environment

INFO = ("success", "collision", "timeout", "path_length", "shortest_path")


def _senses(settings: Environment) -> dict[str, Any]:
    """What a policy must find again where it is judged: robot, time, and lidar."""
    return {
        "robot": settings.robot,
        "physics": settings.physics,
        "max_steps": settings.max_steps,
        "action_repeat": settings.action_repeat,
        # The lidar saturates where the training ends an episode, and tells all distances above.
        "closeness_distance": training_distance(settings),
    }


def training_distance(settings: Environment) -> float:
    """Distance of the robot's center from an obstacle that training counts as a collision [m]."""
    return resolve_robot(settings.robot).radius + settings.margin


def make_training_env(world: str, settings: Environment) -> EnvBase:
    """The environment to learn in.

    Args:
        world: Map or world file.
        settings: The environment's settings.

    Returns:
        The environment, with the entries of ``info`` that a run records.
    """
    return make_navigation_env(
        world,
        info_keys=INFO,
        collision_distance=training_distance(settings),
        progress_scale=settings.progress_scale,
        detour_chance=settings.detour_chance,
        **_senses(settings),
    )


def make_evaluation_env(
    world: str, settings: Environment, *, render_mode: Literal["rgb_array"] | None = None
) -> NavigationEnv:
    """The environment that a policy was trained in, with contact as the only collision.

    Args:
        world: Map or world file.
        settings: The environment's settings in training.
        render_mode: As in :class:`~mpfa_envs.NavigationEnv`.

    Returns:
        The environment.
    """
    return NavigationEnv(
        world=world, collision_distance="contact", render_mode=render_mode, **_senses(settings)
    )
