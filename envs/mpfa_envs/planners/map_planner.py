"""A driver that plans a path on the known map when an episode begins, and follows it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_positive
from mpfa_envs.driver import Errand, Senses
from mpfa_envs.paths.distance import MANY_CELLS, DistanceField, FreeGrid
from mpfa_envs.paths.grid_loops import STEP_SCALE
from mpfa_envs.robots.model import TRAINING_CLEARANCE, RobotModel
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.worlds.shapes import Point
from mpfa_envs.worlds.world import World


class Search(Protocol):
    """Finds a path between two positions over the free cells of a grid."""

    def __call__(self, grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
        """Positions from start to goal (x, y), with centers of cells between [m]; None if none."""


def shortest_path(grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
    """Find the shortest path, as a :class:`Search`.

    Examples:
        >>> from mpfa_envs import WORLDS
        >>> from mpfa_envs.paths.distance import FreeGrid
        >>> from mpfa_envs.planners import path_length, shortest_path
        >>> grid = FreeGrid(WORLDS["B"], distance=0.25)
        >>> path = shortest_path(grid, (0.0, 0.0), (4.0, 0.0))
        >>> round(path_length(grid, path), 6) == round(grid.length((0.0, 0.0), (4.0, 0.0)), 6)
        True
    """
    if not grid.joins(start, goal):
        return None
    # From the goal back to the start, down the lengths of the paths from there.
    lengths = DistanceField(grid, start, until=goal).lengths
    firsts, first_gaps = grid.around(start)
    gap_of = dict(zip(map(tuple, firsts.tolist()), first_gaps.tolist(), strict=True))
    cells, gaps = grid.around(goal)
    places = [goal]
    while True:
        best = (lengths[cells[:, 0], cells[:, 1]] + gaps).argmin()
        i, j = cells[best].tolist()
        places.append(grid.center(i, j))
        if lengths[i, j] == gap_of.get((i, j)):
            return [start, *places[::-1]]
        # The longest moves come first, so that of equally short paths always the same is found.
        cells = grid.neighbors(i, j)[::-1]
        gaps = np.hypot(*(cells - (i, j)).T) * (grid.resolution * STEP_SCALE)


def path_length(grid: FreeGrid, path: list[Point]) -> float:
    """Measure a path as :meth:`~mpfa_envs.paths.distance.FreeGrid.length` does.

    Args:
        grid: The grid.
        path: Positions, as a :class:`Search` finds them [m].

    Returns:
        Length [m], with moves between cells a little shorter than their lines.
    """
    steps = [math.dist(one, other) for one, other in pairwise(path)]
    return steps[0] + STEP_SCALE * sum(steps[1:-1]) + steps[-1]


_SPACING: Final = 0.05
"""Distance between the points of a path [m]."""
_WINDOW: Final = 2.0
"""Length of the path ahead that is searched for the robot's place [m]."""
_BESIDE: Final = math.radians(60.0)
"""To a point farther to the side the robot turns on its tightest circle [rad]."""
_BEHIND: Final = math.radians(120.0)
"""A point farther to the side than this is behind the robot [rad]."""
_FACING: Final = math.radians(10.0)
"""A point less to the side than this is faced [rad]."""
_RIM: Final = 0.03
"""Clearance that the robot's rim keeps if it can [m]."""
_ARC: Final = 0.5
"""Length of the arcs that are tested [m]."""
_SLOWER: Final = 0.8
"""Share of its speed that a robot that can stop loses towards a point at that angle."""
_TURN_TIME: Final = 0.4
"""Time in which a turn on the spot would be made at its first speed [s]."""
_CURVATURES: Final = 41
"""Number of arcs that are tested."""


class PurePursuit:
    r"""Pure pursuit of one path (Coulter 1992, CMU-RI-TR-92-01).

    The robot drives at the farthest point of the path within the look-ahead distance :math:`L` to
    which the straight line is as free as the path. At an angle :math:`\alpha` and a distance
    :math:`l` that point is on the arc of curvature :math:`\kappa = 2 \sin(\alpha) / l`. One wheel
    is at its fastest; the other is slower by what the arc asks for, as far as it can be. To a point
    beside or behind it the robot turns on its tightest circle. Of the arcs that are free for the
    next half meter it takes the one nearest to the wanted arc.

    A robot that can stop turns on the spot to a point beside or behind it, and where no arc is free
    for as long as it takes to brake. It drives no faster than it can brake in the free part of its
    arc, and more slowly the farther to the side the point is.

    Args:
        path: Positions from the start to the goal [m].
        robot: Whose wheels are driven.
        grid: The free places of the world.
        look_ahead: L [m].

    Raises:
        ValueError: If the path has no two positions, or the look-ahead distance is not positive.

    Examples:
        >>> from mpfa_envs import ROBOTS, WORLDS
        >>> from mpfa_envs.paths.distance import FreeGrid
        >>> from mpfa_envs.planners import PurePursuit
        >>> grid = FreeGrid(WORLDS["A"], distance=0.25)
        >>> pursuit = PurePursuit([(0.0, 0.0), (3.0, 0.0)], ROBOTS["turtlebot2"], grid)
        >>> pursuit.act(0.0, 0.0, 0.0)
        (1.0, 1.0)
        >>> left, right = pursuit.act(0.5, 0.2, 0.0)  # To the left of the path: turn right.
        >>> left > right
        True
    """

    def __init__(
        self, path: Sequence[Point], robot: RobotModel, grid: FreeGrid, *, look_ahead: float = 0.6
    ) -> None:
        self.look_ahead = check_positive("look_ahead", look_ahead)
        if len(path) < 2:
            raise ValueError(f"path must have two positions at least, got {list(path)}")
        self.robot, self.grid = robot, grid
        self.points = _resampled(np.asarray(path, dtype=np.float64))
        """The path [m], ``[points, 2]``."""
        self._place = 0
        self._side = 0.0
        # Neither wheel goes backwards on an arc: that is for turns on the spot.
        slow, fast = max(robot.min_wheel_speed, 0.0), robot.max_wheel_speed
        self._slow = slow
        self._tightest = 2.0 * (fast - slow) / (robot.wheel_base * (fast + slow))
        self._curvatures = np.linspace(-self._tightest, self._tightest, _CURVATURES)
        along = np.arange(_SPACING, _ARC + 1e-9, _SPACING)
        half = 0.5 * self._curvatures[:, None] * along
        # Along the chord of the arc; np.sinc(x) is sin(pi x) / (pi x).
        directions = np.stack((np.cos(half), np.sin(half)), axis=-1)
        self._arcs = (along * np.sinc(half / math.pi))[..., None] * directions

    def act(self, x: float, y: float, heading: float) -> tuple[float, float]:
        """Speeds of left and right wheel at a pose [m, m, rad], from -1, the slowest, to 1."""
        ahead_x, ahead_y = self._point_ahead(x, y)
        angle = math.remainder(math.atan2(ahead_y - y, ahead_x - x) - heading, math.tau)
        if self.robot.can_stop and abs(angle) > _BESIDE:
            return self._turn_on_the_spot(angle)
        if abs(angle) > _BESIDE:
            wanted = self._turn_to(angle)
        else:
            self._side = 0.0
            # Near the end of the path the arc would become as tight as the point is near.
            distance = max(math.hypot(ahead_x - x, ahead_y - y), 2 * _SPACING)
            wanted = 2.0 * math.sin(angle) / distance
        curvature, free = self._nearest_free(x, y, heading, wanted)
        if not self.robot.can_stop:
            return self._wheels(curvature, self.robot.max_wheel_speed)
        if free < _SPACING:
            # The point is in the open: once the robot faces it, it may creep there.
            if abs(angle) > _FACING:
                return self._turn_on_the_spot(angle)
            curvature, free = 0.0, 0.5 * _SPACING
        return self._wheels(curvature, self._safe_speed(angle, free))

    def _point_ahead(self, x: float, y: float) -> Point:
        """The point to drive at."""
        window = self.points[self._place : self._place + round(_WINDOW / _SPACING)]
        gaps = np.hypot(*(window - (x, y)).T)
        nearest = int(gaps.argmin())
        self._place += nearest
        window, gaps = window[nearest:], gaps[nearest:]
        within = np.flatnonzero(gaps <= self.look_ahead)
        if not len(within):
            return tuple(window[0].tolist())
        # From the farthest to the nearest of them.
        candidates = window[: within[-1] + 1][::-1]
        clearances = self._line_clearances(x, y, candidates)
        # Beside the path it may be as narrow for the robot as it may be at all.
        distances = self.grid.distance, self.robot.radius + _RIM
        least = next((each for each in distances if (clearances >= each).any()), math.inf)
        return tuple(candidates[int((clearances >= least).argmax())].tolist())

    def _line_clearances(self, x: float, y: float, to: NDArray[np.float64]) -> NDArray[np.float32]:
        """Least clearance on the straight line to each point [m], ``[points]``."""
        shares = np.linspace(0.0, 1.0, 1 + math.ceil(self.look_ahead / _SPACING))[1:, None]
        places = (x + shares * (to[:, 0] - x), y + shares * (to[:, 1] - y))
        return np.asarray(self._clearances(*places).min(axis=0))

    def _turn_to(self, angle: float) -> float:
        """Curvature of the tightest circle to a point [1/m]; behind, it keeps its side."""
        if not (self._side and abs(angle) > _BEHIND):
            self._side = math.copysign(1.0, angle)
        return self._side * self._tightest

    def _nearest_free(self, x: float, y: float, heading: float, wanted: float) -> Point:
        """Curvature nearest to the wanted one of an arc that is free for longest [1/m, m]."""
        cosine, sine = math.cos(heading), math.sin(heading)
        across, up = self._arcs[..., 0], self._arcs[..., 1]
        clearances = self._clearances(
            x + across * cosine - up * sine, y + across * sine + up * cosine
        )
        blocked = clearances < self.robot.radius + _RIM
        # An arc that is blocked nowhere is free for all of its steps.
        steps = np.where(blocked.any(axis=1), blocked.argmax(axis=1), blocked.shape[1])
        off = np.abs(self._curvatures - wanted)
        best = np.lexsort((off, -steps))[0]
        return float(self._curvatures[best]), float(steps[best]) * _SPACING

    def _clearances(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float32]:
        """Clearances of the cells at some places [m], of any shape."""
        grid = self.grid
        columns, rows = (
            np.clip(np.rint((at - first) / grid.resolution).astype(np.int64), 0, count - 1)
            for at, first, count in zip((x, y), grid.origin, grid.free.shape, strict=True)
        )
        return np.asarray(grid.clearance[columns, rows])

    def _turn_on_the_spot(self, angle: float) -> tuple[float, float]:
        """Actions that turn to a point; behind, the robot keeps its side."""
        side = math.copysign(1.0, self._turn_to(angle))
        speed = 0.5 * self.robot.wheel_base * abs(angle) / _TURN_TIME
        speed = min(speed, self.robot.wheel_limits.across, self.robot.max_wheel_speed)
        return self._action(-side * speed), self._action(side * speed)

    def _safe_speed(self, angle: float, free: float) -> float:
        """Speed of the faster wheel [m/s], for a point at an angle and the free part of an arc."""
        limits = self.robot.wheel_limits
        speed = limits.fast * (1.0 - _SLOWER * abs(angle) / _BESIDE)
        # Half the speed from which it can brake: speeds follow the decisions late.
        return min(speed, 0.5 * math.sqrt(2.0 * limits.acceleration * free))

    def _wheels(self, curvature: float, fast: float) -> tuple[float, float]:
        """The wheel speeds on an arc [1/m], the faster one at a speed [m/s], left is positive."""
        half = 0.5 * self.robot.wheel_base * abs(curvature)
        inner = self._action(max(fast * (1.0 - half) / (1.0 + half), self._slow))
        outer = self._action(fast)
        return (inner, outer) if curvature > 0.0 else (outer, inner)

    def _action(self, speed: float) -> float:
        """Action of a wheel's speed [m/s]."""
        slow, fast = self.robot.min_wheel_speed, self.robot.max_wheel_speed
        return min(max(2.0 * (speed - slow) / (fast - slow) - 1.0, -1.0), 1.0)


def _resampled(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points along a path, evenly spaced, with its ends."""
    along = np.append(0.0, np.hypot(*np.diff(path, axis=0).T).cumsum())
    count = max(2, 1 + math.ceil(along[-1] / _SPACING))
    at = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(at, along, values) for values in path.T], axis=1)


_LEAST_CLEARANCE: Final = 0.02
"""Clearance tried where no path has the wanted one [m]."""
_FINE: Final = 0.05
"""Side of a cell of the grid for it [m]."""


class _Frame:
    """A world's frame, in which places of another frame are looked up."""

    def __init__(self, pose: tuple[float, float, float]) -> None:
        self._x, self._y, self.heading = pose
        self._cosine, self._sine = math.cos(self.heading), math.sin(self.heading)

    def place(self, x: float, y: float) -> Point:
        """A place of the other frame in this one [m]."""
        across, up = x - self._x, y - self._y
        cosine, sine = self._cosine, self._sine
        return across * cosine + up * sine, up * cosine - across * sine


class MapPlanner:
    """Plans on the known map and follows the path, a :class:`~mpfa_envs.driver.Driver`.

    It knows all obstacles and the robot's pose, neither of which is in the observation: its results
    are a ceiling for policies that have the lidar alone.

    Where no path keeps the clearance it takes one that keeps less, on finer cells, and where there
    is none at all it drives at the goal.

    Args:
        search: Finds a path.
        robot: The robot.
        clearance: Least clearance of the robot's rim on a path [m].
        resolution: Side of a cell of the grid [m], longer in worlds of more than 200 m.
        look_ahead: Of the :class:`~mpfa_envs.planners.PurePursuit` [m].

    Raises:
        ValueError: If a length is not positive.

    Examples:
        >>> from mpfa_envs import evaluate
        >>> from mpfa_envs.planners import MapPlanner, shortest_path
        >>> planner = MapPlanner(shortest_path)
        >>> [each.success for each in evaluate(planner, "D", episodes=3, physics="kinematic")]
        [True, True, True]
    """

    def __init__(
        self,
        search: Search,
        *,
        robot: RobotChoice = "turtlebot2",
        clearance: float = TRAINING_CLEARANCE,
        resolution: float = 0.1,
        look_ahead: float = 0.6,
    ) -> None:
        self.search = search
        self.robot = resolve_robot(robot)
        self.clearance = check_positive("clearance", clearance)
        self.resolution = check_positive("resolution", resolution)
        self.look_ahead = check_positive("look_ahead", look_ahead)
        self.env_arguments: dict[str, Any] = {"robot": self.robot, "physics": "kinematic"}
        """Arguments of the environments that it drives in, unless others are given."""
        self._followed: dict[int, tuple[PurePursuit, _Frame]] = {}
        self._grids: dict[tuple[float, float], FreeGrid] = {}

    def begin(self, robot: int, errand: Errand) -> None:
        """Plan the path of a robot's errand.

        Raises:
            ValueError: If the errand has no world.
        """
        if errand.world is None:
            raise ValueError("world must be known to a planner of paths, got an errand without")
        to_world = _Frame(errand.world_pose)
        start, goal = to_world.place(*errand.start[:2]), to_world.place(*errand.goal)
        path, grid = self.plan(errand.world, start, goal)
        pursuit = PurePursuit(path, self.robot, grid, look_ahead=self.look_ahead)
        self._followed[robot] = pursuit, to_world

    def drive(self, senses: Senses) -> NDArray[np.float32]:
        """Actions that follow the paths of the N robots, ``[N, 2]``; observations are not read."""
        actions = []
        for robot, pose in zip(senses.robots.tolist(), senses.poses.tolist(), strict=True):
            pursuit, to_world = self._followed[robot]
            x, y = to_world.place(pose[0], pose[1])
            actions.append(pursuit.act(x, y, pose[2] - to_world.heading))
        return np.array(actions, dtype=np.float32)

    def plan(self, world: World, start: Point, goal: Point) -> tuple[list[Point], FreeGrid]:
        """Positions of a path from start to goal [m], and the grid that it was found on."""
        # In a world of more than 100 m the finest cells would be too many.
        least = 1.01 * math.sqrt(math.prod(world.size) / MANY_CELLS)
        coarse, fine = max(self.resolution, least), max(min(_FINE, self.resolution), least)
        for clearance, resolution in (
            (self.clearance, coarse),
            (self.clearance, fine),
            (_LEAST_CLEARANCE, fine),
        ):
            grid = self._grid_of(world, self.robot.radius + clearance, resolution)
            path = self.search(grid, start, goal)
            if path is not None:
                return path, grid
        return [start, goal], grid

    def _grid_of(self, world: World, distance: float, resolution: float) -> FreeGrid:
        """The grid of a world, kept as the next task is often in the same world."""
        kept = self._grids.get((distance, resolution))
        if kept is None or kept.world is not world:
            kept = FreeGrid(world, distance=distance, resolution=resolution)
            self._grids[distance, resolution] = kept
        return kept
