"""Where a goal lies: on the map that a robot makes, in the plan that it knows, or anywhere."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.checks import check_positive
from mpfa_envs.deploy.map_path import MapPath, Plan, check_on_map, pair_of, plan_at, sides_of
from mpfa_envs.sensing.glances import Glances
from mpfa_envs.sensing.observation import lidar_pose
from mpfa_envs.sensing.standing import standing_hits, standing_sectors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.deploy.card import Card
    from mpfa_envs.robots.model import RobotModel
    from mpfa_envs.sensing.sectors import Points
    from mpfa_envs.worlds.world import World


class Ground:
    """A goal, and the map and the plan in which it lies; all in the frame of the odometry."""

    def __init__(
        self,
        card: Card,
        map_size: float,  # [m]
        *,
        robot: RobotModel,
        moves: bool,  # True if something may come
    ) -> None:
        side = check_positive("map_size", map_size)
        self._card = card
        self._map_size = side if card.memory == "map" else None
        # Its loops are compiled before the first decision is due.
        self.map = MapPath(card) if card.memory == "map" else None
        self.glances = Glances(card, robot, moves=moves)
        self.goal: tuple[float, float] | None = None
        """The goal (x, y) [m]; None without."""
        self.plan: Plan | None = None
        self.is_new = True
        """True until the first observation on the way to the goal."""
        self._center: tuple[float, float] | None = None
        self._begins = False

    @property
    def begins(self) -> bool:
        """True if the next observation is the first of a goal or of a map."""
        return self.is_new or self._begins

    def begin(
        self,
        goal: tuple[float, float],
        center: tuple[float, float] | None,  # of the map; None: where the robot is then
        plan: World | None,
        plan_pose: tuple[float, float, float],
    ) -> None:
        """Set out for a goal."""
        center = None if center is None else pair_of("map_center", center)
        goal = pair_of("goal", goal)
        placed = None if plan is None else plan_at(plan, plan_pose)
        if placed is not None:
            placed.check(has_map=self.map is not None, center=center)
            center = placed.middle
        check_on_map(goal, center, placed, self._map_size)
        self.goal, self.plan, self._center, self.is_new = goal, placed, center, True

    def move_goal(self, goal: tuple[float, float]) -> None:
        """Correct the goal."""
        if (goal := pair_of("goal", goal)) != self.goal:
            check_on_map(goal, self._center, self.plan, self._map_size)
            self.goal = goal
            if self.map is not None:
                self.map.look_again()

    def move_plan(self, pose: tuple[float, float, float]) -> None:
        """Correct the pose of the plan; where walls come to other cells, the map begins again."""
        if self.plan is None:
            raise ValueError(f"plan must be given to begin() before it moves, got {pose}")
        moved = plan_at(self.plan.world, pose)
        if self.plan.is_off(moved.pose):
            self.plan, self._center, self._begins = moved, moved.middle, True

    def closes_in(self, radius: float, place: tuple[float, float]) -> bool:
        """Return True if walls that are known keep a place from within a radius of the goal."""
        if self.map is None or self.goal is None or self.begins:
            return False
        return self.map.closes_in(self.goal, radius, place)

    def check_at(self, place: tuple[float, float]) -> None:
        """Reject a goal that is not on the map of a robot at a place."""
        if self.goal is not None:
            check_on_map(self.goal, self._center or place, self.plan, self._map_size)

    def standing(
        self,
        states: NDArray[np.float64],  # poses of the robot first, [S, 5]
        taken: NDArray[np.float64],  # pose of the scan, [3]
        points: Points,
    ) -> NDArray[np.bool_] | None:
        """Sectors of each state that hold walls of the plan alone, ``[S, sectors]``; or None."""
        if self.plan is None:
            return None
        card, plan = self._card, self.plan
        scan, far = (taken, points.angles, points.ranges), card.max_range
        hits = standing_hits(plan.world, (*plan.middle, plan.pose[2]), *scan, far)
        view, mount = math.radians(card.field_of_view), card.robot.lidar_mount[:2]
        places = [lidar_pose(state, *mount) for state in states]
        return np.array(
            [standing_sectors(hits, *scan, far, place, view, card.sectors) for place in places]
        )

    def path(
        self,
        pose: NDArray[np.float64],
        taken: NDArray[np.float64],
        points: Points,
        *,
        radius: float,  # of the goal [m]
        place: tuple[float, float],  # of the robot; that of the map if it begins now
        time: float,  # of the decision [s]
    ) -> NDArray[np.float64]:
        """Enter points taken at a pose; the path from another, ``[0, 3]`` or as that of the map."""
        if self.begins:
            self.glances.begin()
        self.glances.add(taken, points, time)
        if self.map is None or self.goal is None:
            return np.zeros((0, 3))
        if self.begins:
            self._center, self._begins = self._center or place, False
            self.map.begin(self._center, sides_of(self.plan, self._map_size), self.plan)
            if self.is_new and self.plan is not None:
                self.map.reject_closed(self.goal, radius, place)
        return self.map.sense(pose, taken, self.goal, points)

    def known(self) -> tuple[World | None, tuple[float, float, float]]:
        """The world of the plan, and the pose of its frame; None without a plan."""
        if self.plan is None:
            return None, (0.0, 0.0, 0.0)
        return self.plan.world, (*self.plan.middle, self.plan.pose[2])
