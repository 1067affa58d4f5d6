"""Shortest paths of a disc-shaped robot among the obstacles of a world.

Obstacles are grown by the robot's radius, and A* searches the graph of lines of sight between
their corners. Where a path bends around a corner the optimum is an arc; ours follows a polygon
around it, at most 3 % longer on that arc: 7 mm per right angle at a radius of 0.18 m. All else is
exact: there is no grid, and a free straight line is the answer.

Lines of sight grow with the square of the corners. :func:`shortest_length` therefore asks the grid
of :mod:`~mpfa_envs.paths.distance` in worlds with many.
"""

from __future__ import annotations

import heapq
import math
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_positive
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.worlds.shapes import Point
from mpfa_envs.worlds.world import World

_TOUCH = 1e-9
"""A line that grazes a grown obstacle by less than this does not cross it [m]."""
_CORNER_ANGLES = np.radians([15.0, 45.0, 75.0])
"""Three tangents to the quarter circle around a corner meet its polygon at these angles [rad]."""
_WIDEST_ANGLE = math.pi / 6
"""Widest angle between two corners of the polygon around any other corner [rad]."""
_CIRCLE_CORNERS = 16
"""Corners of the polygon around a cylinder."""
_MOST_CORNERS = 500
"""In worlds with more corners than this, lengths come from a grid: planning takes seconds."""
_FINE = 0.05
"""Side of the grid's cells in rooms of up to 250 m² [m]; twice this in larger ones."""


class PathPlanner:
    """Finds shortest paths of a disc's center that keep its radius from obstacles and walls.

    Lines of sight are found when a search first needs them and kept, so the first paths in a world
    take milliseconds and later ones less.

    Args:
        world: The room and its obstacles.
        radius: Radius of the disc [m].

    Raises:
        ValueError: If the radius is not a positive length.

    Examples:
        >>> from mpfa_envs import WORLDS
        >>> from mpfa_envs.paths.planner import PathPlanner
        >>> planner = PathPlanner(WORLDS["B"], radius=0.18)
        >>> planner.is_straight((0.0, 0.0), (2.0, 3.0)), planner.is_straight((0.0, 0.0), (4.0, 0.0))
        (True, False)
        >>> round(planner.length((0.0, 0.0), (4.0, 0.0)), 2)  # [m]
        6.39
    """

    def __init__(self, world: World, *, radius: float) -> None:
        self.world = world
        self.radius = check_positive("radius", radius)
        reach = self.radius - _TOUCH
        circles: list[tuple[float, float, float]] = []
        corners: list[NDArray[np.float64]] = []
        for box in world.boxes:
            for quarter, (x, y) in enumerate(
                (
                    (box.x_max, box.y_max),
                    (box.x_min, box.y_max),
                    (box.x_min, box.y_min),
                    (box.x_max, box.y_min),
                )
            ):
                circles.append((x, y, reach))
                angles = _CORNER_ANGLES + quarter * math.pi / 2
                corners.append(_polygon(x, y, self.radius / math.cos(math.radians(15)), angles))
        for cylinder in world.cylinders:
            grown = cylinder.radius + self.radius
            circles.append((cylinder.x, cylinder.y, grown - _TOUCH))
            around = np.arange(_CIRCLE_CORNERS) * (2 * math.pi / _CIRCLE_CORNERS)
            outer = grown / math.cos(math.pi / _CIRCLE_CORNERS)
            corners.append(_polygon(cylinder.x, cylinder.y, outer, around))
        for polygon in world.polygons:
            for (x0, y0), (x, y), (x1, y1) in polygon.corners:
                circles.append((x, y, reach))
                # From the normal of the edge before to that of the edge after.
                first = math.atan2(x0 - x, y - y0)
                turn = math.remainder(math.atan2(x - x1, y1 - y) - first, math.tau)
                if turn > 0.0:
                    count = math.ceil(turn / _WIDEST_ANGLE)
                    around = first + (np.arange(count) + 0.5) * (turn / count)
                    outer = self.radius / math.cos(turn / count / 2)
                    corners.append(_polygon(x, y, outer, around))
        # Sides, rectangles in the last axis; centers and squared radii, circles in the last axis.
        self._low, self._high = world.arrays.boxes.reshape(-1, 2, 2).transpose(1, 2, 0)
        *self._centers, radii = np.array(circles).reshape(-1, 3).T
        self._squares = radii * radii
        self._segments = world.arrays.segments.T
        nodes = np.concatenate([np.empty((0, 2)), *corners])
        self._nodes = nodes[world.clearances(nodes) >= self.radius - _TOUCH]
        self._neighbors: dict[int, list[tuple[int, float]]] = {}

    def is_straight(self, start: Point, goal: Point) -> bool:
        """Tell whether the disc can take the straight line between two positions [m]."""
        return bool(self._visible(start, np.array([goal]))[0])

    def find(self, start: Point, goal: Point) -> list[Point] | None:
        """Corners of the shortest path between two positions [m], with both; None without one."""
        if not self._fits(start, goal):
            return None
        if self.is_straight(start, goal):
            return [start, goal]
        return self._search(start, goal)

    def is_reachable(self, start: Point, goal: Point) -> bool:
        """Tell whether there is a path, which is quicker than finding the shortest."""
        if not self._fits(start, goal):
            return False
        if self.is_straight(start, goal):
            return True
        groups = self._groups
        from_start = set(groups[self._visible(start, self._nodes)].tolist())
        return not from_start.isdisjoint(groups[self._visible(goal, self._nodes)].tolist())

    def _fits(self, *points: Point) -> bool:
        """Tell whether the disc fits at all of these positions."""
        return all(self.world.clearance(*at) >= self.radius - _TOUCH for at in points)

    @cached_property
    def _groups(self) -> NDArray[np.int64]:
        """Connected part of the room in which each corner lies, shape ``[corners]``."""
        groups = np.full(len(self._nodes), -1, dtype=np.int64)
        for first in range(len(groups)):
            if groups[first] >= 0:
                continue
            groups[first] = first
            frontier = [first]
            while frontier:
                x, y = self._nodes[frontier.pop()]
                # Only corners without a group are tested, which soon are few.
                left = np.flatnonzero(groups < 0)
                found = left[self._visible((x, y), self._nodes[left])]
                groups[found] = first
                frontier += found.tolist()
        return groups

    def length(self, start: Point, goal: Point) -> float:
        """Length of the shortest path between two positions [m]; infinite if there is none."""
        path = self.find(start, goal)
        if path is None:
            return math.inf
        return sum(math.dist(path[i], path[i + 1]) for i in range(len(path) - 1))

    def _search(self, start: Point, goal: Point) -> list[Point] | None:
        """A* over the corners, with the distance to the goal as the estimate."""
        nodes = self._nodes
        # Lists: one number at a time is read faster from them than from arrays.
        to_goal: list[float] = np.hypot(*(nodes - goal).T).tolist()
        sees_goal: list[bool] = self._visible(goal, nodes).tolist()
        from_start: list[float] = np.hypot(*(nodes - start).T).tolist()
        best = [math.inf] * len(nodes)
        parents: dict[int, int] = {}
        queue: list[tuple[float, int]] = []
        for node in np.flatnonzero(self._visible(start, nodes)).tolist():
            best[node] = from_start[node]
            heapq.heappush(queue, (best[node] + to_goal[node], node))
        closed: set[int] = set()
        last, shortest = -1, math.inf
        while queue and queue[0][0] < shortest:
            _, node = heapq.heappop(queue)
            if node in closed:
                continue
            closed.add(node)
            reached = best[node]
            if sees_goal[node] and reached + to_goal[node] < shortest:
                last, shortest = node, reached + to_goal[node]
            for neighbor, step in self._neighbors_of(node):
                if reached + step < best[neighbor]:
                    best[neighbor] = reached + step
                    parents[neighbor] = node
                    heapq.heappush(queue, (best[neighbor] + to_goal[neighbor], neighbor))
        if last < 0:
            return None
        path = [goal]
        while last >= 0:
            path.append((float(nodes[last, 0]), float(nodes[last, 1])))
            last = parents.get(last, -1)
        return [start, *reversed(path)]

    def _neighbors_of(self, node: int) -> list[tuple[int, float]]:
        """Corners in sight of a corner and their distances [m]."""
        if node not in self._neighbors:
            position = self._nodes[node]
            seen = self._visible((position[0], position[1]), self._nodes)
            seen[node] = False
            distances = np.hypot(*(self._nodes - position).T)
            index = np.flatnonzero(seen)
            self._neighbors[node] = list(
                zip(index.tolist(), distances[index].tolist(), strict=True)
            )
        return self._neighbors[node]

    def _visible(self, origin: Point, targets: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which targets ``[N, 2]`` are joined to the origin by a free line, shape ``[N]``."""
        # All of these points are far enough from obstacles themselves, so that a line comes too
        # near to a box only by crossing it or by passing one of its corners.
        x, y = origin
        step_x, step_y = np.ascontiguousarray((targets - origin).T)
        free = np.ones(len(targets), dtype=np.bool_)
        if self._low.size:
            # The line is origin + t * step with t in [0, 1]; [N, boxes] from here on.
            enter, leave = np.zeros(()), np.ones(())
            for axis, (start, step) in enumerate(((x, step_x), (y, step_y))):
                inverse = 1.0 / np.where(step == 0.0, 1e-300, step)[:, None]
                low = inverse * (self._low[axis] - start)
                high = inverse * (self._high[axis] - start)
                enter = np.maximum(enter, np.minimum(low, high))
                leave = np.minimum(leave, np.maximum(low, high))
            free &= (enter >= leave).all(axis=1)
        if self._segments.size:
            free &= ~self._crosses_edges(origin, targets)
        if self._squares.size:
            # [N, circles]: does the foot of the perpendicular lie on the line, and in the circle?
            step_x, step_y = step_x[:, None], step_y[:, None]
            across, up = self._centers[0] - x, self._centers[1] - y
            length = step_x * step_x + step_y * step_y
            along = step_x * across + step_y * up
            aside = step_x * up - step_y * across
            meets = aside * aside < self._squares * length
            meets &= along > 0.0
            meets &= along < length
            free &= ~meets.any(axis=1)
        return free

    def _crosses_edges(self, origin: Point, targets: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which lines from the origin to the targets ``[N, 2]`` cross an edge, ``[N]``."""
        # A line through the end of an edge does not occur: it passes a corner too near.
        x0, y0, x1, y1 = self._segments
        x, y = origin
        to_x, to_y = targets[:, :1], targets[:, 1:]
        step_x, step_y = to_x - x, to_y - y
        # [N, edges]: are the ends of the edge on two sides of the line, and those of the line on
        # two sides of the edge?
        first = step_x * (y0 - y) - step_y * (x0 - x)
        last = step_x * (y1 - y) - step_y * (x1 - x)
        here = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
        there = (x1 - x0) * (to_y - y0) - (y1 - y0) * (to_x - x0)
        crosses = ((first < 0.0) != (last < 0.0)) & ((here < 0.0) != (there < 0.0))
        return np.asarray(crosses.any(axis=1))


def _polygon(
    x: float, y: float, radius: float, angles: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Points at the angles around a center [m], shape ``[angles, 2]``."""
    return np.stack((x + radius * np.cos(angles), y + radius * np.sin(angles)), axis=1)


def is_small(world: World) -> bool:
    """Tell whether a world has few enough corners for exact paths."""
    if world.occupancy is not None:
        return False
    corners = 12 * len(world.boxes) + _CIRCLE_CORNERS * len(world.cylinders)
    corners += sum(2 * len(polygon.vertices) for polygon in world.polygons)
    return corners <= _MOST_CORNERS


def shortest_length(world: World, radius: float, start: Point, goal: Point) -> float:
    """Measure the shortest path of a disc [m]; infinite without one."""
    # In a world with few corners it is that of the :class:`PathPlanner`. In others it comes from a
    # grid of 0.05 m, or 0.1 m in a room of more than 250 m²: within 2.5 % of the planner's where
    # that was measured, and infinite for passages that are wider than the disc by less than a cell.
    measure = _length_of_planner if is_small(world) else _length_on_grid
    return measure(world, radius, start, goal)


# Lengths are kept, as a reset asks twice for them, and an evaluation before its first episode.
@lru_cache(maxsize=512)
def _length_of_planner(world: World, radius: float, start: Point, goal: Point) -> float:
    """Measure the shortest path exactly [m]."""
    return planner_for(world, radius).length(start, goal)


@lru_cache(maxsize=512)
def _length_on_grid(world: World, radius: float, start: Point, goal: Point) -> float:
    """Measure the shortest path on a grid [m]."""
    for point in (start, goal):
        if world.clearance(*point) < radius - _TOUCH:
            return math.inf
    # Moves are measured a little short, so that a straight path is not shorter than its line.
    return max(grid_for(world, radius).length(start, goal), math.dist(start, goal))


@lru_cache(maxsize=4)
def grid_for(world: World, distance: float) -> FreeGrid:
    """Share one grid, and its graph of several megabytes, among the users of a world."""
    large = world.size[0] * world.size[1] > 250.0
    return FreeGrid(world, distance=distance, resolution=min((1 + large) * _FINE, distance))


@lru_cache(maxsize=64)
def planner_for(world: World, radius: float) -> PathPlanner:
    """Share one planner, and the lines of sight it has found, among the users of a world."""
    return PathPlanner(world, radius=radius)
