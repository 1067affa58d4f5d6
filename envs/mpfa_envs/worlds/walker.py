"""Cylinders that move: how large, how fast, and where to."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, get_args

from mpfa_envs.checks import all_finite, keep
from mpfa_envs.worlds.shapes import Point

Behavior = Literal["straight", "waypoints", "orca"]
"""Rule by which a walker chooses its path."""

MOST_WALKERS: Final = 100
"""Greatest number of walkers in a world."""
MOST_WAYPOINTS: Final = 100
"""Greatest number of waypoints of a walker."""
FASTEST: Final = 5.0
"""Greatest speed of a walker [m/s]."""
_NARROWEST: Final = 0.01
"""Least radius [m]: a walker moves by its radius at a time, so as not to pass a thin wall."""
PERSONAL_SPACE: Final = 0.5
"""A robot that comes nearer to a walker, rim to rim, is in its personal space [m]."""
FAR: Final = 10.0
"""A walker that is farther from a robot than this does not count [m]."""
_SHORTEST_LEG: Final = 1e-3
"""Least distance between two waypoints in a row: a step must not go around countless times [m]."""
HORIZON: Final = 10.0
"""Collisions are predicted up to this time ahead [s]."""


@dataclass(frozen=True, kw_only=True)
class Walker:
    """An upright cylinder that moves through a room, say a person.

    Its start is sampled in every episode, by the robot's seed.

    Args:
        radius: Radius [m], at least 0.01.
        speed: Speed [m/s], at most 5.
        behavior: ``"straight"``: from anywhere in any direction, straight ahead until it meets a
            wall, an obstacle or another walker, off which it bounces. ``"waypoints"``: from one
            waypoint to the next, after the last one to the first, from anywhere on this round; it
            walks through other walkers. Neither sees the robot. ``"orca"``: likewise between
            waypoints, no faster than its speed, around obstacles, other walkers and the robot
            (:class:`~mpfa_envs.walkers.batch.OrcaRoom`), which needs
            ``pip install 'torchrl-mpfa[orca]'``.
        waypoints: Positions (x, y) between which walkers other than ``"straight"`` go [m], at least
            two.

    Raises:
        ValueError: If a number is out of its range, the behavior is unknown or the waypoints do
            not fit it.

    Examples:
        >>> from mpfa_envs import NavigationEnv, Walker, World
        >>> guard = Walker(behavior="waypoints", waypoints=((-3, 0), (3, 0)))
        >>> world = World(name="guarded", walkers=(guard, Walker(speed=0.2)))
        >>> env = NavigationEnv(world=world, physics="kinematic")
        >>> _ = env.reset(seed=0)
        >>> env.walkers.shape  # x, y, the speeds in both directions, and the radius
        (2, 5)
    """

    radius: float = 0.25
    speed: float = 0.3
    behavior: Behavior = "straight"
    waypoints: tuple[Point, ...] = ()

    def __post_init__(self) -> None:
        if not (all_finite((self.radius,)) and self.radius >= _NARROWEST):
            raise ValueError(f"radius must be at least {_NARROWEST} m, got {self.radius!r}")
        if not (all_finite((self.speed,)) and 0.0 < self.speed <= FASTEST):
            raise ValueError(f"speed must be above 0 and at most {FASTEST:g}, got {self.speed!r}")
        keep(self, "radius", "speed")
        if self.behavior not in get_args(Behavior):
            raise ValueError(f"behavior must be one of {get_args(Behavior)}, got {self.behavior!r}")
        try:
            given = [tuple(point) for point in self.waypoints]
        except TypeError:
            raise ValueError(
                f"waypoints must be a list of positions, got {self.waypoints}"
            ) from None
        if self.behavior == "straight":
            if given:
                raise ValueError(
                    f"waypoints must be empty with behavior='straight', got {self.waypoints}"
                )
        elif not 2 <= len(given) <= MOST_WAYPOINTS:
            raise ValueError(
                f"waypoints must be 2 to {MOST_WAYPOINTS} with behavior={self.behavior!r}, got "
                f"{len(given)}"
            )
        if not all(len(point) == 2 and all_finite(point) for point in given):
            raise ValueError(f"waypoints must be finite positions (x, y), got {self.waypoints}")
        points = tuple((float(x), float(y)) for x, y in given)
        # The dataclass is frozen; this is its only change, before it is used.
        object.__setattr__(self, "waypoints", points)
        for one, other in self.legs:
            if math.dist(one, other) < _SHORTEST_LEG:
                raise ValueError(
                    f"waypoints must differ from the ones before them, got {one} and {other}"
                )

    @property
    def legs(self) -> tuple[tuple[Point, Point], ...]:
        """Lines from each waypoint to the next, and from the last to the first [m]."""
        return tuple(zip(self.waypoints, (*self.waypoints[1:], *self.waypoints[:1]), strict=True))


def no_encounters() -> tuple[float, float, float]:
    """Least distance [m], time in personal space [s] and time to collision [s] at the start."""
    return FAR, 0.0, HORIZON
