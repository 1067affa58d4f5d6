"""From scan, odometry and goal to wheel speeds: one decision of a policy, or of a planner."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.checks import check_bool, check_not_negative, check_number
from mpfa_envs.deploy.adaptation import (
    body_of,
    cannot_turn,
    filter_of,
    nearest_admissible,
    on_the_spot,
    pace_of,
    ramped,
    reject_blind_front,
    tolerance,
)
from mpfa_envs.deploy.asked import Asked, rescued
from mpfa_envs.deploy.card import Card, Network, check_finite, read_exported
from mpfa_envs.deploy.command import Command
from mpfa_envs.deploy.ground import Ground
from mpfa_envs.deploy.maneuvers import Arrival, WayBack
from mpfa_envs.deploy.map_path import pair_of
from mpfa_envs.deploy.rehearsal import rehearse
from mpfa_envs.robots.drives import OFF, Orders
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.safety.filter import CLEARANCE, SafetyFilter
from mpfa_envs.sensing.scan import Scan
from mpfa_envs.sensing.sectors import Sectors, Silent, observations_from

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

    from mpfa_envs.driver import Action, Driver
    from mpfa_envs.worlds.world import World

_TOWARDS: Final = math.radians(45.0)
"""A robot drives where it sees all directions that differ from its own by less [rad]."""


class Pilot:
    """Runs a policy or a planner on a robot: NumPy and onnxruntime, and Numba if it has a map.

    A slower robot than that of the training drives the same arcs at a slower pace p: its decisions
    come later and its speeds are read as if it were the other one. Speeds are p times as large and
    accelerations p² times, so that a robot whose wheels change more slowly has a slower pace, too.
    Whatever the card says of its radius, speeds and wheels, the robot's own count.

    The robot does not drive where the scan does not look: if it would, it turns on the spot.

    Args:
        card: Of the policy.
        driver: From observations ``[1, O]`` to actions ``[1, 2]``, or a
            :class:`~mpfa_envs.driver.Driver`, which drives robot 0.
            :func:`~mpfa_envs.planners.make_pilot` makes a pilot of a planner.
        robot: What drives, as any environment takes it; None: the robot that the policy learned
            with.
        pace: Its speed as a share of that in training, in (0, 1]; None: as fast as both can, so
            that it turns, accelerates and brakes as the policy learned.
        mount: Position of the lidar, as for :class:`~mpfa_envs.deploy.Sectors`; None: that of the
            robot, its ``lidar_mount``.
        unseen: As there.
        silent: As there.
        map_size: Side of the map of a policy that has one [m], a square around the robot's first
            position; the path leads through it alone. With a plan the map is as large as that.
        clearance: Clearance of the rim that a :class:`~mpfa_envs.SafetyFilter` keeps [m]; None: no
            filter, as for a robot that cannot stop.
        approach: Speed of what may come, before which the filter has it stand [m/s]: all that is
            seen and what that hides, walls too, but those of a plan.
        latency: Time from a scan to the moment at which the wheels take the order that follows from
            it [s]; None: that of the robot. The pilot decides for the state that it comes to by the
            orders under way. Its filter allows for 0.05 s more or less, and for slower wheels.
        goal_radius: Distance from the goal at which it has arrived [m]; None: as in training.
            Near it the robot drives so slowly that it stops where it arrives.
        rescue: If True, and there are a map and a filter, a planner leads the robot away where it
            stands still again (:class:`~mpfa_envs.control.rescue.Rescued`).

    Raises:
        CardError: If the robot does not fit the policy.
        ImportError: If the policy has a map and there is no Numba.
        ValueError: If an argument is out of its range.
    """

    def __init__(
        self,
        card: Card,
        driver: Action | Driver,
        *,
        robot: RobotChoice | None = None,
        pace: float | None = None,
        mount: tuple[float, ...] | None = None,
        unseen: float | None = None,
        silent: Silent = "reject",
        map_size: float = 40.0,
        clearance: float | None = None,
        approach: float = 0.0,
        latency: float | None = None,
        goal_radius: float | None = None,
        rescue: bool = True,
    ) -> None:
        self.card = card
        self.robot = card.robot if robot is None else resolve_robot(robot)
        self.pace = pace_of(self.robot, card.robot, pace)
        late = self.robot.latency if latency is None else latency
        self.latency = check_not_negative("latency", late)
        mount = self.robot.lidar_mount if mount is None else mount
        self.sectors = Sectors(
            card, mount=mount, unseen=unseen, silent=silent, radius=self.robot.radius
        )
        self._arrival = Arrival(
            self.robot, card, goal_radius, pace=self.pace, period=self.period, latency=self.latency
        )
        self._approach = check_not_negative("approach", approach)
        self._ground = Ground(card, map_size, robot=self.robot, moves=approach > 0.0)
        self._body = body_of(card.robot, self.robot, self.pace)
        self._keep = self._filter(clearance)
        if check_bool("rescue", rescue) and card.memory == "map" and self._keep is not None:
            driver = rescued(driver)
        self._asked = Asked(driver, card, self._ground, self._make_filter)
        self._planned: SafetyFilter | None = None
        self._way_back = WayBack(card.robot, self.period)
        self._orders, self._time = Orders(self.robot), 0.0
        self._observation = np.zeros((1, self.card.observation_size), dtype=np.float32)

    @classmethod
    def load(cls, path: str | os.PathLike[str], **options: Any) -> Pilot:
        """Read an exported policy, and compile loops, which takes seconds at the first time.

        Args:
            path: The ONNX file; its card lies next to it.
            **options: As in :class:`Pilot`.

        Returns:
            The pilot.

        Raises:
            FileNotFoundError: If the file or its card is missing.
            CardError: If they are damaged or do not fit.
        """
        card, content = read_exported(path)
        network = Network(content, card.observation_size, card.action_size)
        rehearse(cls(card, network, **options))
        return cls(card, network, **options)

    @property
    def period(self) -> float:
        """Time from decision to decision [s]."""
        return self.card.period / self.pace

    @property
    def goal_radius(self) -> float:
        """Distance from the goal at which it has arrived [m]."""
        return self._arrival.radius

    def adjust(self, *, clearance: float | None = None, goal_radius: float | None = None) -> None:
        """Change clearance or goal radius, also while driving; None leaves it as it is [m]."""
        if clearance is not None:
            self._keep = self._filter(clearance)
        if goal_radius is not None:
            self._arrival.set_radius(goal_radius)

    def _filter(self, clearance: float | None) -> SafetyFilter | None:
        """Make the filter that keeps a clearance [m]; None: no filter."""
        # At a slower pace things come faster, in the policy's time.
        return filter_of(self.card, self.robot, self._body, clearance, self._approach / self.pace)

    @property
    def recoveries(self) -> int:
        """How often the robot has driven back since it set out."""
        return self._way_back.count

    @property
    def is_led(self) -> bool:
        """True while predictive control leads a robot away that stood still again."""
        return self._asked.is_led

    @property
    def has_filter(self) -> bool:
        """True if a filter keeps the robot off what it sees."""
        return self._keep is not None

    @property
    def goal(self) -> tuple[float, float] | None:
        """The goal (x, y) [m]; None without."""
        return self._ground.goal

    @property
    def plan(self) -> World | None:
        """The building that :meth:`begin` was given; None without, and without a goal."""
        plan = self._ground.plan
        return None if plan is None or self.goal is None else plan.world

    @property
    def turns_on_the_spot(self) -> bool:
        """True if the robot can turn on the spot, as a heading at the goal needs."""
        return self._arrival.spot_speed > 0.0

    def begin(
        self,
        goal: tuple[float, float],
        *,
        map_center: tuple[float, float] | None = None,
        plan: World | None = None,
        plan_pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
        heading: float | None = None,
    ) -> None:
        """Set out for a goal with an empty memory, or with a plan.

        Args:
            goal: Position (x, y) in the frame of the odometry [m].
            map_center: Center of the map of a policy that has one (x, y) [m]; None: where the robot
                is at its first decision.
            plan: The building, for a policy with a map, which then begins with its walls; scans
                add what the plan does not have. None: the map begins empty.
            plan_pose: Of the plan's frame, that of its coordinates or of its ROS map, in the frame
                of the odometry (x, y, heading) [m, m, rad].
            heading: Direction to which the robot turns on the spot at the goal, in the frame of the
                odometry [rad]; None: any.

        Raises:
            ValueError: If a number is not finite or beyond 1e7 m, the goal is not on the map, there
                is a plan without a map or with a center, or a heading for a robot that cannot turn
                on the spot.
        """
        self._arrival.check(heading)
        self._ground.begin(goal, map_center, plan, plan_pose)
        self._arrival.begin(heading)
        self._way_back = WayBack(self.card.robot, self.period)

    def stop(self) -> None:
        """Give up the goal."""
        self._ground.goal = None

    def move_goal(self, goal: tuple[float, float], *, heading: float | None = None) -> None:
        """Correct the goal while driving; the map is kept.

        Args:
            goal: Position (x, y) in the frame of the odometry [m].
            heading: As for :meth:`begin`; None: as it was.

        Raises:
            ValueError: If it is not finite, beyond 1e7 m or not on the map, or the robot has not
                set out.
        """
        if self.goal is None:
            raise ValueError(f"goal must be given to begin() before it moves, got {goal}")
        if heading is not None and self._arrival.heading is not None:
            self._arrival.heading = check_number("heading", heading)
        self._ground.move_goal(goal)

    def move_plan(self, pose: tuple[float, float, float]) -> None:
        """Correct the pose of the plan while driving, as localization does.

        Where walls would be in other cells, the map begins again.

        Args:
            pose: As ``plan_pose`` of :meth:`begin` [m, m, rad].

        Raises:
            ValueError: If a number is not finite or too large, or there is no plan.
        """
        self._ground.move_plan(pose)

    def arrived(self, pose: tuple[float, float, float]) -> bool:
        """Return True if a pose is at the goal, with the heading that :meth:`begin` was given."""
        goal = self.goal
        return goal is not None and self._arrival.is_at(pose, math.dist(pose[:2], goal))

    def closed_in(self, place: tuple[float, float]) -> bool:
        """Return True if all paths from a place (x, y) to the goal cross walls that are known.

        Unseen places count as free. Without a map nothing is known.
        """
        return self._ground.closes_in(self.goal_radius, place)

    def observe(
        self,
        scan: Scan,
        pose: tuple[float, float, float],
        speeds: tuple[float, float],
        *,
        scan_pose: tuple[float, float, float] | None = None,
        time: float | None = None,
        age: float = 0.0,
    ) -> NDArray[np.float32]:
        """Build the policy's observation, once for each decision.

        The robot is taken to stop then, unless :meth:`give` names its order.

        Args:
            scan: What the lidar has measured.
            pose: Of the robot (x, y, heading) in the frame of the odometry [m, m, rad].
            speeds: Forward and turning speed [m/s, rad/s].
            scan_pose: Pose at the time of the scan; None: it is of now.
            time: Time of the decision [s]; None: a period after the last one.
            age: Age of pose and speeds then [s].

        Returns:
            The observation, ``[O]``.

        Raises:
            ScanError: If the scan lacks the range of a sector.
            ValueError: If there is no goal or it is not on the map, or a number is not finite.
        """
        return self._observe(scan, pose, speeds, scan_pose, time, age)[0][0]

    def _observe(
        self,
        scan: Scan,
        pose: tuple[float, float, float],
        speeds: tuple[float, float],
        scan_pose: tuple[float, float, float] | None,
        time: float | None,
        age: float,
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
        """Observations that the filter allows for, ``[S, O]``; their states; turns till then."""
        if self.goal is None:
            raise ValueError("goal must be given to begin() first")
        x, y, heading = check_finite("pose", pose, 3)
        pair_of("pose", (x, y))
        motion = np.array((x, y, heading, *check_finite("speeds", speeds, 2)))
        taken = np.array(check_finite("scan_pose", scan_pose or (x, y, heading), 3))
        self._time = self._time + self.period if time is None else check_number("time", time)
        ahead = self._orders.states(
            motion, check_number("age", age), self._time, self.latency, certain=not self.has_filter
        )
        # Unless there is another order, as after an error: who gets none stops.
        self.give(self._time, 0.0, 0.0)
        self._ground.check_at((x, y))
        if self._ground.begins:
            self._asked.begin()
        ranges, points = self.sectors.read(scan)
        path = self._ground.path(
            ahead[0], taken, points, radius=self.goal_radius, place=(x, y), time=self._time
        )
        self._still = self._ground.standing(ahead, taken, points) if self._approach else None
        facts = self.goal, self._ground.is_new, path, self.pace
        rows = observations_from(ahead, ranges, points, taken, self.card, self._observation, *facts)
        self._observation[0] = rows[0]
        self._ground.is_new = False
        return rows, ahead, ahead[:, 2] - taken[2]

    def give(self, time: float, linear: float, angular: float) -> None:
        """Remember what was ordered, where that is not what the pilot has decided.

        Args:
            time: When it was ordered, by the clock of the decisions [s].
            linear: Forward speed [m/s].
            angular: Turning speed [rad/s].
        """
        self._orders.give(time, linear, angular)

    def decide(
        self,
        scan: Scan,
        pose: tuple[float, float, float],
        speeds: tuple[float, float],
        *,
        scan_pose: tuple[float, float, float] | None = None,
        time: float | None = None,
        age: float = 0.0,
        scan_age: float = 0.0,
    ) -> Command:
        """Choose the speeds for the next :attr:`period`; arguments and errors as :meth:`observe`.

        Args:
            scan: As there.
            pose: As there.
            speeds: As there.
            scan_pose: As there.
            time: As there.
            age: As there.
            scan_age: Age of the scan then [s], in which things may have come nearer.

        Returns:
            The speeds.

        Raises:
            ScanError: Also if it would drive where it does not see and cannot turn on the spot.
        """
        if not self.arrived(pose) and self._arrival.turns:
            self._time = self._time + self.period if time is None else check_number("time", time)
            return self._command(0.0, self._arrival.turn(pose[2], speeds[0]))
        rows, ahead, turns = self._observe(scan, pose, speeds, scan_pose, time, age)
        blind, hidden = self.sectors.blind(scan, turns)
        learned, goal = self.card.robot, self._ground.goal or pose[:2]
        slower = self._arrival.fastest(pose, goal)
        # Whatever the policy reads in them, what was not seen begins at the rim.
        states = rows.copy()
        states[:, : self.card.sectors][:, hidden] = self._ground.glances.closeness(ahead, hidden)
        action = self._asked.act(rows, states, ahead, goal, self.goal_radius)
        reverses = not (np.abs(blind) > math.pi - _TOWARDS).any()
        back = self._way_back.speeds(pose, self._time, reverses=reverses, led=self._asked.is_led)
        left, right = back or learned.wheel_speeds(action)
        share = min(1.0, slower / max(abs(left + right) / 2.0, 1e-9))
        left, right = share * left, share * right
        towards = blind if left + right >= 0.0 else math.pi - np.abs(blind)
        backwards = left + right < 0.0 and not self.robot.reverse
        if backwards or (np.abs(towards) < _TOWARDS).any():
            left, right = on_the_spot(self.robot, learned, left, right)
        if self._keep is not None:
            reject_blind_front(blind + turns[0])
            # Wheels that brake all the time stand a time step later than those that do so in steps.
            old = self.pace * (scan_age + self.latency + OFF) + self._keep.body.time_step
            seen = states, self._still, hidden
            left, right = nearest_admissible(self._keep, learned, seen, (left, right), old)
        linear = self.pace * 0.5 * (left + right)
        return self._command(linear, self.pace * (right - left) / learned.wheel_base)

    def _make_filter(self) -> SafetyFilter:
        """The filter of this pilot, or the one that it would have."""
        made = self._planned = self._keep or self._planned or self._filter(CLEARANCE)
        if made is None:
            raise ValueError("driver must be one without a filter, for a robot that has none")
        return made

    def _command(self, linear: float, angular: float) -> Command:
        """The command for speeds of the body [m/s, rad/s]."""
        turn = 0.5 * angular * self.robot.wheel_base
        if linear - abs(turn) < self.robot.min_wheel_speed - tolerance(self.robot):
            raise cannot_turn(self.robot)
        self.give(self._time, linear, angular)
        return Command(linear - turn, linear + turn, linear, angular)

    @property
    def stands_still(self) -> bool:
        """True if the robot has come nowhere of late (``mpfa_envs.deploy.maneuvers``)."""
        return self._way_back.stands_still

    def ramp(
        self, last: tuple[float, float], wanted: tuple[float, float], passed: float
    ) -> tuple[float, float]:
        """Change the speeds to order no faster than the policy knows and the robot can.

        Args:
            last: Forward and turning speed ordered last [m/s, rad/s].
            wanted: Those of the present :class:`Command`.
            passed: Time since the last order [s].

        Returns:
            The speeds to order.
        """
        return ramped(self._body, self.card.robot.wheel_base, last, wanted, passed * self.pace**2)
