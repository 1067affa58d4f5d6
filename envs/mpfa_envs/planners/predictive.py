"""Model predictive control: the wheel speeds that take the least time on the robot's own map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.checks import check_seed
from mpfa_envs.paths.grid_loops import MOVES, STEP_SCALE, path_lengths
from mpfa_envs.planners.predictive_loops import CELL, Effort, PlanningState, best_plan, room_around
from mpfa_envs.robots.motion_loops import pairs_within
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.safety.loops import least_room, room_for_points, see
from mpfa_envs.sensing.map_loops import BLOCKED, cell_of
from mpfa_envs.sensing.map_memory import RESOLUTION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.env.config import TaskConfig
    from mpfa_envs.env.vector import VectorNavigationEnv
    from mpfa_envs.safety.loops import Body
    from mpfa_envs.sensing.map_loops import MapArrays
    from mpfa_envs.worlds.shapes import Point

_FACTORS: Final = np.array((5, 8, 150, 1000))
"""Cost of a step in a free cell, one near an obstacle, a tight and a blocked one."""
_STEP: Final = RESOLUTION * STEP_SCALE / 5
"""Length of a straight step over its cost [m]."""
_BUCKETS: Final = 2500
"""More than the costliest step costs."""
_LENGTH: Final = 1.12
"""Length of a plan at full speed [m]."""
_HELD: Final = 0.14
"""Length that the robot drives at full speed from decision to decision [m]."""
_SAMPLES: Final = 80
"""Plans that are sampled in each of three rounds."""
_SPEEDS: Final = 5
"""Speeds of a wheel that are tried after one another."""
_TURN: Final = 1.1
"""Angle for whose turn at full speed a radian beside the path counts [rad]."""
_REACHED: Final = 0.94
"""Share of the goal's radius within which a plan ends: the wheels are not exact."""
_WAIT: Final = 0.3
"""Share of a plan's time that it must save to begin without moving."""
_STUCK: Final = 2.5
"""Time after which a robot that has not left a place is stuck [s]."""
_PLACE: Final = 0.1
"""Radius of such a place [m]."""
_RAISED: Final = 25
"""By how much cells cost more before which a robot was stuck: half a meter each."""
_AHEAD: Final = 12
"""Cells of the path ahead of a stuck robot among which the sectors show what closes it."""


@dataclass
class _Episode:
    """What a robot remembers during one episode."""

    plan: NDArray[np.float64]  # wheel speeds of the time steps ahead [m/s], [T, 2]
    goal: Point  # [m]
    levels: NDArray[np.uint8]  # its map when the lengths were found, [columns, rows]
    raised: NDArray[np.int64]  # by how much cells cost more since it was stuck before them
    lengths: NDArray[np.float64]  # of the cheapest paths from each cell to the goal [m]
    place: Point = (math.inf, math.inf)  # the last one that it left [m]
    waited: int = 0  # decisions since then, or since it was stuck


class PredictiveControl:
    r"""Sampling model predictive control, a :class:`~mpfa_envs.evaluation.runs.Driver`.

    It has what a policy with a map has: the sectors of the lidar, the speeds, the map of what the
    lidar hit and the pose by odometry. With late orders all of these are of the moment when the
    next order acts. Robot, lidar, filter and time steps are those of the environment.

    - *Cost-to-go.* Dijkstra's algorithm finds the lengths of the cheapest paths to the goal on the
      robot's map. Cells that nothing has hit are free.
    - *Sampling.* Candidates are the last plan, pairs of constant speeds after one another, and
      normal samples around the best plan in three rounds of falling spread.
    - *Rollout.* Each plan drives the kinematic model of a differential drive, with its limits of
      speed, turn and acceleration. Its cost is its time, more of it near obstacles, and the time
      from its end to the goal: along the path, to turn to it and to reach full speed.
    - *Terminal constraint.* After its end the plan must stop, or drive a full circle if the robot
      cannot, without coming nearer to what the sectors show than the filter keeps.
    - *Filter.* A plan begins with an action that the :class:`~mpfa_envs.SafetyFilter` lets pass, by
      the test of the filter itself.
    - *Recovery.* If the robot does not leave a place for 2.5 s, cells of the path before it cost
      half a meter more for the rest of the episode, as in guided local search: those where the
      sectors show no room. So another path becomes the cheapest, in the end the one back.

    Args:
        robot: Whose wheels are driven.
        seed: Seed of the samples, which are the same in each decision.

    Raises:
        ValueError: If the seed is negative.

    Examples:
        >>> from mpfa_envs import evaluate
        >>> from mpfa_envs.planners import PredictiveControl
        >>> planner = PredictiveControl(robot="kobuki")
        >>> [each.success for each in evaluate(planner, "D", episodes=3)]
        [True, True, True]
    """

    def __init__(self, *, robot: RobotChoice = "turtlebot2", seed: int = 0) -> None:
        self.robot = resolve_robot(robot)
        shape = (3, _SAMPLES, 4, 2)
        self._noise = np.random.default_rng(check_seed(seed)).standard_normal(shape)
        # Of time steps of 0.1 s.
        repeat = max(2, round(10.0 * _HELD / self.robot.max_wheel_speed))
        self.env_arguments: dict[str, Any] = {
            "robot": self.robot,
            "physics": "kinematic",
            "memory": "map",
            "action_repeat": repeat,
        }
        """Arguments of the environments that it drives in, unless others are given. A slow robot
        holds its actions for longer, as its policies do."""
        self._config: TaskConfig | None = None
        self._episodes: dict[int, _Episode] = {}

    def begin(self, env: VectorNavigationEnv, robot: int) -> None:
        """Forget the last episode of a robot.

        Raises:
            ValueError: If robots have no map, or the filter cannot keep this robot off obstacles.
        """
        maps, task = _maps(env), env.tasks[robot]
        if task is None:
            raise ValueError(f"robot {robot} must have begun an episode to plan for")
        if env.config is not self._config:
            self._prepare(env.config)
        plan = np.full((self._ahead.repeat, 2), max(self._body.limits.slow, 0.0))
        columns, rows = maps.shapes[robot]
        # No cell is on a map of this level: the lengths are found in the first decision.
        levels = np.full((columns, rows), BLOCKED + 1, np.uint8)
        raised = np.zeros((columns, rows), np.int64)
        self._episodes[robot] = _Episode(plan, task.goal, levels, raised, raised.astype(float))

    def _prepare(self, config: TaskConfig) -> None:
        """Take robot, lidar, filter and time steps from a task."""
        self._keep = config.make_filter()
        self._body = body = self._keep.body
        limits = body.limits
        steps = max(round(_LENGTH / limits.fast / body.time_step), 2 * body.repeat)
        self._ahead = body._replace(repeat=steps)
        self._pairs = _speeds_to_try(body)
        circle = 0
        if limits.slow > 0.0:
            whole = math.tau * body.wheel_base / (limits.fast - limits.slow)
            circle = math.ceil(whole / body.time_step)
        either = limits.reverse and limits.slow < -0.9 * limits.fast
        turn, wait = _TURN / config.robot.max_angular_speed, _WAIT * _LENGTH / limits.fast
        self._effort = Effort(turn, wait, either, circle)
        reach = limits.fast * (steps * body.time_step + 0.5 * limits.fast / limits.acceleration)
        half = math.ceil((reach + 0.1) / CELL)
        self._rooms = np.empty((2 * half + 1, 2 * half + 1))
        self._radius = _REACHED * config.goal_radius
        # Set last: what was rejected is rejected again.
        self._config = config

    def drive(
        self,
        env: VectorNavigationEnv,
        robots: NDArray[np.int64],
        observations: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Actions of the N robots, ``[N, 2]``, by their observations, maps and odometry."""
        slow, fast = self._body.limits.slow, self._body.limits.fast
        actions = []
        for robot, observation in zip(robots.tolist(), observations, strict=True):
            scene, plan = self._scene(env, robot, observation), self._episodes[robot].plan
            time = best_plan(plan, self._pairs, self._noise, scene, self._body, self._effort)
            if time == math.inf:
                plan[:] = max(slow, 0.0)
            actions.append(2.0 * (plan[0] - slow) / (fast - slow) - 1.0)
        return self._keep(observations, np.array(actions, dtype=np.float32))

    def _scene(
        self, env: VectorNavigationEnv, robot: int, observation: NDArray[np.float32]
    ) -> PlanningState:
        """What a robot knows when it decides."""
        episode, maps = self._episodes[robot], _maps(env)
        columns, rows = episode.levels.shape
        levels, (left, low) = maps.levels[robot, :columns, :rows], maps.origins[robot].tolist()
        x, y, heading = env.measurements[robot, 4:7].tolist()
        pose = x - left, y - low, heading
        goal = episode.goal[0] - left, episode.goal[1] - low, self._radius
        seen = self._keep.seen(observation[None])
        rays = room_for_points(seen[0].shape[1], self._body.approach)
        points, counts = np.empty((1, rays, 4)), np.empty(1, np.int64)
        see(seen, self._ahead, 0.0, points, counts)
        near = points[0, : counts[0]]
        room_around(near, heading, self._rooms)
        stuck = self._is_stuck(episode, pose[:2])
        if stuck:
            self._penalize(episode, pose)
        if stuck or not np.array_equal(levels, episode.levels):
            episode.levels = levels.copy()
            episode.lengths = path_lengths(
                np.minimum(_FACTORS[levels] + episode.raised, _FACTORS[BLOCKED]),
                np.array([_cell(goal, levels.shape)]),
                np.zeros(1),
                MOVES,
                _STEP,
                math.inf,
                buckets=_BUCKETS,
            )
        least = least_room(near, self._body)
        field = episode.levels, episode.lengths
        return PlanningState(pose, seen[3], points, counts, least, self._rooms[None], *field, goal)

    def _is_stuck(self, episode: _Episode, place: Point) -> bool:
        """Return True once if a robot has not left its place for a while."""
        if math.dist(place, episode.place) > _PLACE:
            episode.place, episode.waited = place, 0
        episode.waited += 1
        stuck = episode.waited * self._body.repeat * self._body.time_step > _STUCK
        episode.waited *= not stuck
        return stuck

    def _penalize(self, episode: _Episode, pose: tuple[float, float, float]) -> None:
        """Make the path costlier where the sectors show no room, for the rest of the episode."""
        i, j = _cell(pose, episode.lengths.shape)
        half = len(self._rooms) // 2
        for _ in range(_AHEAD):
            first, low = max(i - 1, 0), max(j - 1, 0)
            around = episode.lengths[first : i + 2, low : j + 2]
            across, up = np.unravel_index(around.argmin(), around.shape)
            i, j = first + int(across), low + int(up)
            at = round((RESOLUTION * i - pose[0]) / CELL), round((RESOLUTION * j - pose[1]) / CELL)
            if max(map(abs, at)) <= half and self._rooms[half + at[0], half + at[1]] < 0.0:
                break
        episode.raised[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] += _RAISED


def _maps(env: VectorNavigationEnv) -> MapArrays:
    """The robots' maps; raise an error if they have none."""
    if env.maps is None:
        raise ValueError(f"memory must be 'map' for mpc, got {env.config.memory!r}")
    return env.maps


def _cell(place: tuple[float, ...], shape: tuple[int, ...]) -> tuple[int, int]:
    """Column and row of a place on a map [m]."""
    return cell_of(place[0] / RESOLUTION, shape[0]), cell_of(place[1] / RESOLUTION, shape[1])


def _speeds_to_try(body: Body) -> NDArray[np.float64]:
    """Speeds of both wheels that are tried [m/s], the slowest first, ``[K, 2]``."""
    limits = body.limits
    speeds = np.linspace(limits.slow, limits.fast, _SPEEDS)
    slowest = np.full((1, 2), max(limits.slow, 0.0))
    return np.concatenate((slowest, pairs_within(limits, speeds)))
