"""A filter of actions: what could end in a collision is replaced by the nearest that cannot."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.checks import check_count, check_not_negative, check_positive, check_share
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.safety.loops import Body, filter_actions
from mpfa_envs.sensing.observation import Memory, observation_slices

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.robots.model import RobotModel

CLEARANCE: Final = 0.03
"""Clearance of the rim that the filter keeps by default [m]."""
_STEP: Final = math.radians(10.0)
"""Angle between directions that are not seen, which dip by 0.4 % of the radius between them."""


class SafetyFilter:
    """Lets an action pass if the robot can still keep off everything that its lidar sees.

    An action is admissible if the robot's rim stays clear while it is carried out and for the time
    that the robot takes to stand still then. What lies outside of the lidar's field of view is not
    free: a robot that can stop does not drive there. A robot that cannot stand still, as the
    paper's, must have room for a whole turning circle to the left or to the right afterwards. In
    place of any other action the nearest admissible one of a grid is taken; if there is none, the
    robot brakes, or turns.

    A robot that can stop needs a lidar that sees 180 degrees: beside a narrower view it would meet
    what it never saw. What a lidar before or behind the axle does not see at the robot's sides, in
    front of the axle, counts as seen before.

    It is a function of the observation and the action alone, so that every driver can have it:
    a policy, a planner, a training and a robot. :meth:`mpfa_envs.TaskConfig.make_filter` makes the
    one of a task.

    Args:
        robot: A :class:`~mpfa_envs.RobotModel`, or a name in :data:`~mpfa_envs.ROBOTS`.
        angles: Directions of the lidar's rays in the robot's frame, left to right [rad], ``[R]``;
            :attr:`mpfa_envs.Lidar.angles`. Rays begin at the robot's ``lidar_mount``.
        sectors: Number of its sectors, which share the rays.
        max_range: Range of a sector that meets nothing [m].
        closeness_distance: A range of this or less has closeness one [m].
        memory: As for :class:`~mpfa_envs.NavigationEnv`.
        history: As there.
        further: Values of further sensors in an observation, which the filter does not look at.
        time_step: As there [s].
        action_repeat: As there.
        clearance: Clearance of the rim to be kept [m]; a third of it where the robot passes by
            what it is nearer to already.
        samples: Speeds of each wheel among which to find another action.
        braking: Share of the wheels' acceleration with which they slow down at least. Below 1 the
            robot's file is not exact, and it may turn more quickly than its ``turn_acceleration``.
        approach: Speed at which whatever is seen, or hidden by that, may come [m/s]: the robot
            stands before it could be touched by it. 0: nothing moves.
        latency: Time from what an observation shows to the moment at which an action begins [s], in
            which things may come nearer.

    Raises:
        ValueError: If a number is out of its range, the robot can stop and sees less than 180
            degrees, it takes farther than it sees to stand still, or things may come and it cannot
            stop.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs import NavigationEnv, TaskConfig
        >>> task = {"robot": "kobuki", "physics": "kinematic", "contact": True}
        >>> keep_off = TaskConfig(**task).make_filter()
        >>> env = NavigationEnv(world="D", **task)
        >>> observation, info = env.reset(seed=0)
        >>> for _ in range(100):  # Straight on, if it may.
        ...     action = keep_off(observation, np.ones(2))
        ...     observation, *_, info = env.step(action)
        >>> info["collision"]
        False
    """

    def __init__(
        self,
        robot: RobotChoice,
        *,
        angles: NDArray[np.float64],
        sectors: int,
        max_range: float,
        closeness_distance: float,
        memory: Memory = "none",
        history: int = 0,
        further: int = 0,
        time_step: float = 0.1,
        action_repeat: int = 2,
        clearance: float = CLEARANCE,
        samples: int = 9,
        braking: float = 1.0,
        approach: float = 0.0,
        latency: float = 0.0,
    ) -> None:
        self.robot = resolve_robot(robot)
        self._parts = observation_slices(sectors, memory=memory, history=history)
        self._further = check_count("further", further, least=0)
        if len(angles) == 0 or len(angles) % sectors:
            raise ValueError(f"angles must be a multiple of sectors = {sectors}, got {len(angles)}")
        self._sectors, self._rays = sectors, len(angles) // sectors
        mount, radius = np.array(self.robot.lidar_mount[:2]), self.robot.radius
        unseen = np.empty(0)
        if self.robot.can_stop:
            view = math.degrees(float(np.ptp(angles)) * len(angles) / max(len(angles) - 1, 1))
            check_view(self.robot, view)
            unseen = _unseen(angles, mount, radius)
        self._unseen = len(unseen)
        self._rims = _to_rim(angles, mount, radius)
        self._origins = np.zeros((2, len(angles) + len(unseen)))
        self._origins[:, : len(angles)] = mount[:, None]
        around = np.concatenate((angles, unseen))
        self._directions = np.stack((np.cos(around), np.sin(around)))
        self._max_range = check_positive("max_range", max_range)
        self._near = check_positive("closeness_distance", closeness_distance)
        limits = self.robot.wheel_limits
        self.body = Body(
            limits,
            self.robot.wheel_base,
            self.robot.radius,
            check_not_negative("clearance", clearance),
            check_positive("time_step", time_step),
            check_count("action_repeat", action_repeat),
            check_positive("braking", check_share("braking", braking)),
            limits if braking == 1.0 else limits._replace(turning=math.inf),
            check_not_negative("approach", approach),
            check_not_negative("latency", latency),
            len(unseen),
        )
        """Sizes, limits and time steps, as compiled loops read them."""
        if approach and not self.robot.can_stop:
            raise ValueError(
                f"approach must be 0 for {self.robot.name}, which cannot stop before what comes, "
                f"got {approach}"
            )
        reach = _reach(self.body) + math.hypot(*mount)
        if self.robot.can_stop and reach > self._max_range:
            raise ValueError(
                f"max_range must be at least {reach:.3g} m, within which {self.robot.name} "
                f"decides and stops from its greatest speed, got {max_range}"
            )
        self._candidates = _candidates(check_count("samples", samples, least=2), self.body)

    def __call__(
        self,
        observation: NDArray[np.float32],
        action: NDArray[np.float32],
        *,
        still: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Filter actions.

        Args:
            observation: Observations, ``[..., O]``.
            action: What the policy would do, ``[..., 2]``.
            still: True for sectors in which all that is seen is known to stand still,
                ``[..., sectors]``; None: nothing is known.

        Returns:
            The actions that may be carried out, ``[..., 2]``, float32; an admissible one is as it
            was given.

        Raises:
            ValueError: If the shapes do not fit, or there is NaN among them.
        """
        seen = np.asarray(observation)
        states = seen[..., None, :] if seen.ndim else seen
        return self.among(states, action, still=None if still is None else still[..., None, :])

    def among(
        self,
        observations: NDArray[np.float32],
        action: NDArray[np.float32],
        *,
        age: float | None = None,
        still: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Filter actions of robots that may be in any of some states.

        Args:
            observations: Observations in each of the states, ``[..., S, O]``.
            action: What the policy would do, ``[..., 2]``.
            age: Time from what they show to the moment at which the action begins at the latest
                [s]; None: the latency.
            still: As when it is called, in each of the states, ``[..., S, sectors]``.

        Returns:
            The actions that may be carried out in all states, ``[..., 2]``, float32.

        Raises:
            ValueError: As when it is called.
        """
        size = max(part.stop for part in self._parts.values()) + self._further
        seen = np.asarray(observations, dtype=np.float64)
        wanted = np.asarray(action, dtype=np.float32)
        if seen.ndim < 2 or seen.shape[-1] != size:
            shape = seen.shape[:-2] + seen.shape[-1:]
            raise ValueError(f"observation must have shape [..., {size}], got {shape}")
        if wanted.shape != (*seen.shape[:-2], 2):
            raise ValueError(f"action must have shape {(*seen.shape[:-2], 2)}, got {wanted.shape}")
        sectors = (*seen.shape[:-1], self._sectors)
        if still is not None and still.shape != sectors:
            raise ValueError(f"still must have shape {sectors}, got {still.shape}")
        if np.isnan(seen).any() or np.isnan(wanted).any():
            raise ValueError("observation and action must not hold NaN")
        rows = seen.reshape(-1, size)
        actions = np.clip(wanted.reshape(-1, 2), -1.0, 1.0).astype(np.float64)
        chosen = np.empty_like(actions)
        filter_actions(
            actions,
            self._ranges(rows).reshape(len(actions), -1, self._directions.shape[1]),
            self._directions,
            self._origins,
            self._wheel_speeds(rows).reshape(len(actions), -1, 2),
            self._known(still, len(rows)).reshape(len(actions), -1, self._directions.shape[1]),
            self._candidates,
            self.body if age is None else self.body._replace(age=age),
            chosen,
        )
        changed = (chosen != actions).any(axis=1)
        kept = wanted.reshape(-1, 2).copy()
        kept[changed] = chosen[changed]
        return kept.reshape(wanted.shape)

    def seen(
        self, observations: NDArray[np.float32]
    ) -> tuple[
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.bool_],
    ]:
        """What a robot may meet, and how its wheels turn, as compiled loops read it.

        Args:
            observations: Observations in each of the states that it may be in, ``[S, O]``.

        Returns:
            Ranges of the rays [m], ``[S, R]``, infinite where they hit nothing; their directions,
            cosine and sine, and origins (x, y) in the robot's frame [m], ``[2, R]``; the speeds of
            the wheels [m/s], ``[S, 2]``; and that no ray is known to hit what stays, ``[S, R]``.
        """
        rows = np.asarray(observations, dtype=np.float64)
        known = self._known(None, len(rows))
        return self._ranges(rows), self._directions, self._origins, self._wheel_speeds(rows), known

    def _known(self, still: NDArray[np.bool_] | None, rows: int) -> NDArray[np.bool_]:
        """Which rays are known to hit what stays, ``[N, R]``."""
        known = np.zeros((rows, self._directions.shape[1]), dtype=np.bool_)
        if still is not None:
            rays = self._sectors * self._rays
            known[:, :rays] = np.repeat(still.reshape(rows, -1), self._rays, axis=1)
        return known

    def _ranges(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Ranges of all rays [m], ``[N, R]``: each may be the one that its sector reports."""
        closeness = rows[:, self._parts["lidar"]]
        closeness = np.repeat(closeness, self._rays, axis=1)
        ranges = self._near / np.maximum(closeness, 1e-9)
        # What is nearer than the observation can show may be at the rim, but not inside of it: so
        # is what the lidar has not seen.
        ranges = np.where(closeness >= 1.0, self._rims, ranges)
        ranges[ranges >= 0.999 * self._max_range] = math.inf
        # What is not seen begins at the rim, which may leave it but not approach it.
        unseen = np.full((len(rows), self._unseen), self.robot.radius)
        return np.concatenate((ranges, unseen), axis=1)

    def _wheel_speeds(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Speeds of the wheels [m/s], ``[N, 2]``."""
        robot, parts = self.robot, self._parts
        forward = rows[:, parts["linear_speed"]] * robot.max_wheel_speed
        turning = rows[:, parts["angular_speed"]] * robot.max_angular_speed
        across = 0.5 * robot.wheel_base * turning
        return np.concatenate((forward - across, forward + across), axis=1)


def check_view(robot: RobotModel, view: float) -> None:
    """Reject a lidar's view [degrees] behind which a robot that can stop would never drive."""
    if view < 180.0 - 1e-6:
        raise ValueError(
            f"field_of_view must be at least 180 degrees for a filter, behind which {robot.name!r} "
            f"would never drive ahead, got {view:.4g}: take a lidar that sees more, or drive "
            "without the filter (environment.filter=0; clearance=None of a Pilot, 0 of the node)"
        )


def _to_rim(
    angles: NDArray[np.float64], mount: NDArray[np.float64], radius: float
) -> NDArray[np.float64]:
    """Distance of the rim from the lidar in some directions [m]."""
    along = mount[0] * np.cos(angles) + mount[1] * np.sin(angles)
    return np.sqrt(np.maximum(along * along + radius**2 - mount @ mount, 0.0)) - along


def _unseen(
    angles: NDArray[np.float64], mount: NDArray[np.float64], radius: float
) -> NDArray[np.float64]:
    """Directions, every 10 degrees or so, of the rim that the lidar does not see [rad]."""
    first, last = float(angles.min()), float(angles.max())
    step = (last - first) / max(len(angles) - 1, 1)
    begin, gap = last + 0.5 * step, math.tau - (last - first) - step
    if mount.any() and round(gap / _STEP) > 0:
        ends = np.array([begin, begin + gap])
        reach = _to_rim(ends, mount, radius)
        off = np.arctan2(mount[1] + reach * np.sin(ends), mount[0] + reach * np.cos(ends))
        left, right = float(off[0]), float(off[1]) + math.tau * (off[1] < off[0])
        if gap <= math.pi + _STEP:
            left, right = max(left, 0.5 * math.pi), min(right, 1.5 * math.pi)
        begin, gap = left, right - left
    return np.linspace(begin, begin + gap, 2 + round(gap / _STEP))[1:-1]


def _reach(body: Body) -> float:
    """Distance of the farthest point that a robot may come to before it stands [m]."""
    fastest = max(abs(body.limits.slow), abs(body.limits.fast))
    braking = body.braking * body.limits.acceleration
    time = body.repeat * body.time_step + 0.5 * fastest / braking
    comes = body.approach * (body.age + body.repeat * body.time_step + fastest / braking)
    return fastest * time + comes + body.radius + body.clearance


def _candidates(samples: int, body: Body) -> NDArray[np.float64]:
    """Actions of a grid, and the safe one at the end, ``[K, 2]``."""
    limits = body.limits
    values = np.linspace(-1.0, 1.0, samples)
    grid = np.stack(np.meshgrid(values, values), axis=-1).reshape(-1, 2)
    if limits.slow > 0.0:
        return np.concatenate((grid, [[1.0, -1.0]]))
    middle, span = 0.5 * (limits.fast + limits.slow), 0.5 * (limits.fast - limits.slow)
    stand = -middle / span
    turns = [(-turn + stand, turn + stand) for turn in (-0.5, -0.25, 0.0, 0.25, 0.5)]
    inside = [pair for pair in turns if max(map(abs, pair)) <= 1.0]
    return np.concatenate((grid, inside, [[stand, stand]]))
