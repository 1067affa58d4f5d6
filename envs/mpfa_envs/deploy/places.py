"""Places in the frame of the odometry: goals, the middle of the map, and plans of buildings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from mpfa_envs.checks import MEANT, check_meant
from mpfa_envs.deploy.card import check_finite

if TYPE_CHECKING:
    from mpfa_envs.deploy.map_path import Plan
    from mpfa_envs.worlds.world import World

_FARTHEST: Final = 1e7
"""Largest coordinate of a place [m]; those of UTM are smaller."""
_LARGEST_MAP: Final = 2.0 * MEANT["map_size"][1]
"""Side of the square around a robot in which its goal must be, without a map, too [m]."""


def pair_of(name: str, place: tuple[float, float]) -> tuple[float, float]:
    """Two finite numbers within the range of observations."""
    x, y = check_finite(name, place, 2)
    if max(abs(x), abs(y)) > _FARTHEST:
        raise ValueError(f"{name} must be within {_FARTHEST:g} m of the origin, got {place}")
    return x, y


def placed(world: World, pose: tuple[float, float, float]) -> Plan:
    """A plan at a pose."""
    # Imported here because they need Numba.
    from mpfa_envs.deploy.map_path import Plan
    from mpfa_envs.worlds.world import World

    if not isinstance(world, World):
        # The text of any other object may have an address in memory.
        given = repr(world) if isinstance(world, str | Path) else type(world).__name__
        raise ValueError(f"plan must be a World, got {given}; load_world reads one from a file")
    x, y, heading = check_finite("plan_pose", pose, 3)
    check_meant("plan_pose", heading, "yaw")
    return Plan(world, (*pair_of("plan_pose", (x, y)), heading))


def sides_of(plan: Plan | None, map_size: float | None) -> tuple[float, float]:
    """Width and depth of the map [m]; without one, of what a goal may be away."""
    side = _LARGEST_MAP if map_size is None else map_size
    return (side, side) if plan is None else plan.size


def check_on_map(
    goal: tuple[float, float],
    center: tuple[float, float] | None,
    plan: Plan | None,
    map_size: float | None,  # [m]; None: there is no map
) -> None:
    """Reject a goal beyond the map, once its center is known, or one in another unit."""
    if center is None:
        return
    width, depth = sides_of(plan, map_size)
    if abs(goal[0] - center[0]) > 0.5 * width or abs(goal[1] - center[1]) > 0.5 * depth:
        size = f"{width:g} m" + " (map_size)" * (map_size is not None)
        if plan is not None:
            size = f"{width:g} m x {depth:g} m (plan)"
        raise ValueError(
            f"goal must be on the map, {size} around "
            f"({center[0]:.2f}, {center[1]:.2f}), got ({goal[0]:.2f}, {goal[1]:.2f})"
        )
