"""Model predictive control: the wheel speeds that take the least time on the robot's own map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.checks import check_seed
from mpfa_envs.control.cost_to_go import cost_to_go
from mpfa_envs.control.predictive_loops import CELL, Effort, PlanningState, best_plan, room_around
from mpfa_envs.robots.motion_loops import pairs_within
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.safety.loops import AT_RIM, least_room, room_for_points, see
from mpfa_envs.sensing.map_loops import BLOCKED, cell_of
from mpfa_envs.sensing.map_memory import RESOLUTION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.driver import Errand, Senses
    from mpfa_envs.safety.filter import SafetyFilter
    from mpfa_envs.safety.loops import Body
    from mpfa_envs.sensing.map_loops import MapArrays
    from mpfa_envs.worlds.shapes import Point

_LENGTH: Final = 1.12
"""Length of a plan at full speed [m]."""
_HELD: Final = 0.14
"""Length that the robot drives at full speed from decision to decision [m]."""
_SAMPLES: Final = 80
"""Plans that are sampled in each of three rounds."""
_SPEEDS: Final = 5
"""Speeds of a wheel that are tried after one another."""
_SPINS: Final = np.array([-0.5, -0.2, -0.08, 0.08, 0.2, 0.5])
"""Turns on the spot that one which does not look behind tries, too, over its quickest."""
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
_MOVED: Final = 0.5
"""Distance after which lengths are found again, as those around the robot count [m]."""
_INTO: Final = 0.06
"""How far plans may lead into what the sectors show, where the robot squeezes through [m]. From
afar sectors show door posts wider than they are."""
_SQUEEZED: Final = 1.0
"""Distance from where it was stuck within which it does [m]."""
_AHEAD: Final = 12
"""Cells of the path ahead of a stuck robot among which the sectors show what closes it."""


@dataclass
class _Episode:
    """What a robot remembers during one episode."""

    plan: NDArray[np.float64]  # wheel speeds of the time steps ahead [m/s], [T, 2]
    target: tuple[int, int]  # cell of the goal to which the lengths lead
    levels: NDArray[np.uint8]  # its map when the lengths were found, [columns, rows]
    raised: NDArray[np.int64]  # by how much cells cost more since it was stuck before them
    lengths: NDArray[np.float64]  # of the cheapest paths from each cell to the goal [m]
    found_at: Point = (math.inf, math.inf)  # where the robot was then, from the first cell [m]
    place: Point = (math.inf, math.inf)  # the last one that it left [m]
    waited: int = 0  # decisions since then, or since it was stuck
    squeezed_at: Point = (math.inf, math.inf)  # where it began to squeeze through [m]


class PredictiveControl:
    r"""Sampling model predictive control, a :class:`~mpfa_envs.driver.Driver`.

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
    - *Recovery.* If the robot does not leave a place for 2.5 s, its plans may lead 6 cm into what
      the sectors show, as these show a door narrower than it is. If that does not help, cells of
      the path before it cost half a meter more for the rest of the episode, as in guided local
      search: those where the sectors show no room. So another path becomes the cheapest, in the end
      the one back.

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
            # To the rim: what is nearer than an observation shows is at the rim for the filter.
            "closeness_distance": self.robot.lidar_to_rim,
        }
        """Arguments of the environments that it drives in, unless others are given. A slow robot
        holds its actions for longer, as its policies do."""
        self._keep: SafetyFilter | None = None
        self._episodes: dict[int, _Episode] = {}

    def begin(self, robot: int, errand: Errand) -> None:
        """Forget the last errand of a robot.

        Raises:
            ValueError: If robots have no map, or the filter cannot keep this robot off obstacles.
        """
        if errand.map_shape is None:
            raise ValueError("memory must be 'map' for mpc, got 'none'")
        self._prepare(errand)
        plan = np.full((self._ahead.repeat, 2), max(self._body.limits.slow, 0.0))
        # No cell is on a map of this level: the lengths are found in the first decision.
        levels = np.full(errand.map_shape, BLOCKED + 1, np.uint8)
        raised = np.zeros(errand.map_shape, np.int64)
        self._episodes[robot] = _Episode(plan, (-1, -1), levels, raised, raised.astype(float))

    def _prepare(self, errand: Errand) -> None:
        """Take robot, lidar, filter and time steps from an errand."""
        self._radius = _REACHED * errand.goal_radius
        keep = errand.make_filter()
        if keep is self._keep:
            return
        # The filter of a robot may have finer time steps than it needs to plan.
        step, repeat = errand.time_step, errand.action_repeat
        self._body = body = keep.body._replace(time_step=step, repeat=repeat)
        limits = body.limits
        steps = max(round(_LENGTH / limits.fast / body.time_step), 2 * body.repeat)
        self._ahead = body._replace(repeat=steps)
        self._pairs = _speeds_to_try(body)
        circle = 0
        if limits.slow > 0.0:
            whole = math.tau * body.wheel_base / (limits.fast - limits.slow)
            circle = math.ceil(whole / body.time_step)
        blind = body.unseen > 0
        either = limits.reverse and limits.slow < -0.9 * limits.fast and not blind
        turn, wait = _TURN / keep.robot.max_angular_speed, _WAIT * _LENGTH / limits.fast
        self._effort = Effort(turn, wait, either, circle, blind)
        reach = limits.fast * (steps * body.time_step + 0.5 * limits.fast / limits.acceleration)
        half = math.ceil((reach + 0.1) / CELL)
        self._reach = reach + 2.0 * _MOVED
        self._rooms = np.empty((2 * half + 1, 2 * half + 1))
        # Set last: what was rejected is rejected again.
        self._keep = keep

    def drive(self, senses: Senses) -> NDArray[np.float32]:
        """Actions of the N robots, ``[N, 2]``, by their observations, maps and odometry."""
        keep, maps = self._keep, senses.maps
        if keep is None or maps is None:
            raise ValueError("begin() must be called for each robot before drive()")
        slow, fast = self._body.limits.slow, self._body.limits.fast
        actions = []
        for row, robot in enumerate(senses.robots.tolist()):
            scene, plan = self._scene(keep, maps, senses, row), self._episodes[robot].plan
            time = best_plan(plan, self._pairs, self._noise, scene, self._body, self._effort)
            if time == math.inf and scene.least > -1.0:
                # Nothing leads away from what is too near: what does not lead nearer, then.
                scene = scene._replace(least=-1.0)
                time = best_plan(plan, self._pairs, self._noise, scene, self._body, self._effort)
            if time == math.inf:
                plan[:] = max(slow, 0.0)
            actions.append(2.0 * (plan[0] - slow) / (fast - slow) - 1.0)
        return keep.among(senses.states, np.array(actions, dtype=np.float32))

    def _scene(
        self, keep: SafetyFilter, maps: MapArrays, senses: Senses, row: int
    ) -> PlanningState:
        """What a robot knows when it decides."""
        robot = int(senses.robots[row])
        episode = self._episodes[robot]
        columns, rows = episode.levels.shape
        levels, (left, low) = maps.levels[robot, :columns, :rows], maps.origins[robot].tolist()
        x, y, heading = senses.motions[row, :3].tolist()
        pose = x - left, y - low, heading
        goal_x, goal_y = senses.goals[row].tolist()
        goal = goal_x - left, goal_y - low, self._radius
        seen = keep.seen(senses.states[row])
        states, rays = seen[0].shape
        points = np.empty((states, room_for_points(rays, self._ahead.approach), 4))
        counts = np.empty(states, np.int64)
        see(seen, self._ahead, 0.0, points, counts)
        near = points[0, : counts[0]]
        room_around(near, heading, self._body.radius + AT_RIM, self._rooms)
        squeezed = math.dist(pose[:2], episode.squeezed_at) <= _SQUEEZED
        stuck = self._is_stuck(episode, pose[:2])
        if stuck:
            # First it tries to squeeze through, and only then another path.
            stuck, squeezed = squeezed, not squeezed
            episode.squeezed_at = pose[:2] if squeezed else (math.inf, math.inf)
        if stuck:
            self._penalize(episode, pose)
        target = _cell(goal, levels.shape)
        moved = math.dist(pose[:2], episode.found_at) > _MOVED
        changed = target != episode.target or not np.array_equal(levels, episode.levels)
        if stuck or moved or changed:
            episode.levels, episode.target = levels.copy(), target
            here, reach = _cell(pose, levels.shape), math.ceil(self._reach / RESOLUTION)
            episode.lengths = cost_to_go(levels, episode.raised, target, here, reach)
            episode.found_at = pose[:2]
        least = least_room(near, self._body)
        field = self._rooms[None], episode.levels, episode.lengths
        into = _INTO if squeezed else 0.0
        return PlanningState(pose, seen[3], points, counts, keep.body, least, *field, goal, into)

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


def _cell(place: tuple[float, ...], shape: tuple[int, ...]) -> tuple[int, int]:
    """Column and row of a place on a map [m]."""
    return cell_of(place[0] / RESOLUTION, shape[0]), cell_of(place[1] / RESOLUTION, shape[1])


def _speeds_to_try(body: Body) -> NDArray[np.float64]:
    """Speeds of both wheels that are tried [m/s], the slowest first, ``[K, 2]``."""
    limits = body.limits
    speeds = np.linspace(limits.slow, limits.fast, _SPEEDS)
    slowest = np.full((1, 2), max(limits.slow, 0.0))
    pairs = np.concatenate((slowest, pairs_within(limits, speeds)))
    if body.unseen == 0:
        return pairs
    spins = min(limits.fast, -limits.slow, limits.across) * _SPINS
    return np.concatenate((pairs[pairs.sum(axis=1) >= 0.0], np.stack((-spins, spins), axis=1)))
