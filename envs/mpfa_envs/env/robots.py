"""Many robots in their worlds: moved, sensed and rewarded together by compiled loops."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from mpfa_envs.env.episodes import distance_field
from mpfa_envs.env.step_loops import (
    DISTANCE,
    ENCOUNTERS,
    MIN_CLEARANCE,
    POSE,
    REWARD,
    SHORTEST_PATH,
    EpisodeArrays,
    judge,
    measure_remaining,
    settle,
)
from mpfa_envs.paths.batch import FieldBatch
from mpfa_envs.robots.drives import make_drives
from mpfa_envs.robots.motion_loops import scale_actions
from mpfa_envs.saved import read_array, read_list
from mpfa_envs.sensing.map_memory import MapMemory
from mpfa_envs.sensing.observation import FLAGS, NUMBERS
from mpfa_envs.sensing.observation_loops import observe_all
from mpfa_envs.tables import grown
from mpfa_envs.tasks.reward import StepOutcome, payments_of, read_terms
from mpfa_envs.walkers.batch import WalkerBatch
from mpfa_envs.worlds.batch import WorldBatch
from mpfa_envs.worlds.plain import world_from_plain, world_to_plain
from mpfa_envs.worlds.task import read_task
from mpfa_envs.worlds.walker import no_encounters

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from mpfa_envs.env.config import TaskConfig
    from mpfa_envs.env.episodes import Episode
    from mpfa_envs.sensing.lidar import Lidar
    from mpfa_envs.worlds.task import Task
    from mpfa_envs.worlds.world import World

_TRAIL = 500
"""Time steps that trails have room for at first."""
_NO_PATHS = np.zeros((0, 3))


class RobotBatch:
    """The state of many robots, and its changes."""

    def __init__(self, config: TaskConfig, lidar: Lidar, worlds: Sequence[World]) -> None:
        count = len(worlds)
        self._config = config
        self._lidar = lidar
        self.tasks: list[Task | None] = [None] * count
        """Start and goal of each robot's episode; None before the first."""
        self.worlds = WorldBatch(worlds)
        """The present world of each robot."""
        self.walkers = WalkerBatch(
            self.worlds, radius=config.robot.radius, time_step=config.time_step
        )
        """The walkers around each robot."""
        self._fields = FieldBatch(count) if config.progress == "shortest_path" else None
        self.episodes = EpisodeArrays(
            motions=np.zeros((count, 5)),
            goals=np.zeros((count, 2)),
            numbers=np.zeros((len(NUMBERS), count)),
            flags=np.zeros((len(FLAGS), count), dtype=np.bool_),
            steps=np.zeros(count, dtype=np.int64),
            clearances=np.zeros(count),
            remaining=np.zeros((2, count)),
        )
        """Their episodes so far."""
        self.running = np.zeros(count, dtype=np.bool_)
        """Whether an episode has begun and not ended, ``[N]``."""
        self.trails = np.zeros((count, min(config.max_steps, _TRAIL) + 1, 2))
        """Positions since the start of the episode [m], ``[N, steps, 2]``."""
        self.ranges = np.zeros((count, lidar.angles.size))
        """Range of each ray [m], ``[N, rays]``."""
        self.memory = MapMemory(count, config.robot, lidar) if config.memory == "map" else None
        """The robots' maps, if they have any."""
        width = max(part.stop for part in config.observation_slices.values())
        self.observations = np.zeros((count, width), dtype=np.float32)
        """The last observations, ``[N, O]``."""
        self.drives = make_drives(config.physics, config.robot, count, time_step=config.time_step)
        """The physics."""
        self.noise = config.make_noise(count)
        """Errors of the robots' motion, if there are any."""
        self._held = np.zeros((len(NUMBERS), count))
        robot = config.robot
        self._lengths = (
            robot.radius,
            config.collision_distance,
            config.goal_radius,
            config.time_step,
        )
        self._scales = config.closeness_distance, robot.max_wheel_speed, robot.max_angular_speed
        self._payments = payments_of(config.reward_function)

    def begin(self, index: int, episode: Episode, rng: np.random.Generator) -> None:
        """Start an episode of a robot, whose odometry takes its errors from ``rng``."""
        task, episodes = episode.task, self.episodes
        if self.worlds[index] is not episode.world:
            self.worlds[index] = episode.world
        x, y, heading = task.start
        heading = math.remainder(heading, math.tau)
        distance = math.dist((x, y), task.goal)
        remaining = distance
        if self._fields is not None and episode.field is not None:
            self._fields[index] = episode.field
            remaining = episode.field.at(x, y)
        self.walkers.begin(index, episode.walkers)
        clearance = min(episode.world.clearance(x, y), self.walkers.clearance(index, x, y))
        clearance -= self._config.robot.radius
        self.drives.place(index, x, y, heading)
        self.tasks[index] = task
        episodes.motions[index] = x, y, heading, 0.0, 0.0
        episodes.goals[index] = task.goal
        episodes.flags[:, index] = False
        episodes.steps[index] = 0
        episodes.clearances[index] = clearance
        episodes.remaining[:, index] = remaining
        numbers = episodes.numbers[:, index]
        numbers[:] = 0.0
        numbers[SHORTEST_PATH] = max(episode.shortest_path - self._config.goal_radius, 0.0)
        numbers[MIN_CLEARANCE] = clearance
        numbers[DISTANCE] = distance
        numbers[POSE : POSE + 3] = x, y, heading
        numbers[ENCOUNTERS:] = no_encounters()
        self.trails[index, 0] = x, y
        self.running[index] = True
        if self.noise is not None:
            self.noise.begin(index, (x, y, heading), rng)
        if self.memory is not None:
            self.memory.begin(index, episode.world)

    def wheel_speeds(self, actions: NDArray[np.float32]) -> NDArray[np.float64]:
        """Speeds [m/s] of the left and the right wheel, ``[N, 2]``, by actions of that shape."""
        values = np.ascontiguousarray(actions, dtype=np.float64)
        if values.shape != (len(self.tasks), 2):
            raise ValueError(f"actions must have shape ({len(self.tasks)}, 2), got {values.shape}")
        speeds = np.empty_like(values)
        robot = self._config.robot
        if not scale_actions(values, robot.wheel_limits, speeds):
            rows = np.flatnonzero(np.isnan(values).any(axis=1)).tolist()
            raise ValueError(f"actions must not hold NaN, got some for robots {rows}")
        return speeds

    def advance(
        self,
        speeds: NDArray[np.float64],
        moving: NDArray[np.bool_],
        rngs: Sequence[np.random.Generator],
    ) -> None:
        """Hold the wheel speeds [m/s], ``[N, 2]``, of the moving robots, ``[N]``, for an action."""
        episodes, worlds, running = self.episodes, self.worlds.arrays, moving.copy()
        episodes.numbers[REWARD : REWARD + 4, moving] = 0.0
        last = int(episodes.steps.max()) + self._config.action_repeat
        if last >= self.trails.shape[1]:
            self.trails = grown(self.trails, 2 * last + 1)
        noise = self.noise
        disturb = None if noise is None else partial(noise.drive, running=running, rngs=rngs)
        for _ in range(self._config.action_repeat):
            self.walkers.move(running, episodes.motions)
            self.drives.move(episodes.motions, running, speeds, disturb)
            if noise is not None:
                noise.measure(episodes.motions, running)
            self.walkers.count_encounters(episodes.motions, running, episodes.numbers[ENCOUNTERS:])
            judge(episodes, worlds, running, self.trails, self._lengths, self._config.max_steps)
            if self._fields is not None:
                measure_remaining(episodes, running, self._fields.arrays)
            if self._payments is None:
                self._pay_by_function(running)
            if not settle(episodes, running, self._payments or (0.0, 0.0, 0.0, 0.0)):
                break
        self.running[moving] = running[moving]

    def state_dict(self) -> dict[str, Any]:
        """The state of the robots as plain values and arrays."""
        last = int(self.episodes.steps.max())
        return {
            "worlds": [world_to_plain(world) for world in self.worlds],
            "tasks": [task and (task.start, task.goal) for task in self.tasks],
            "trails": self.trails[:, : last + 1].copy(),
            "drives": self.drives.state_dict(),
            "walkers": self.walkers.state_dict(),
            "memory": {} if self.memory is None else self.memory.state_dict(),
            **{name: array.copy() for name, array in self._arrays().items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state_dict` gave; if it is rejected, nothing has changed."""
        arrays = self._arrays()
        values = {name: read_array(state, name, like) for name, like in arrays.items()}
        plain, given = (read_list(state, name, len(self.tasks)) for name in ("worlds", "tasks"))
        worlds = [world_from_plain(each) for each in plain]
        tasks = [None if task is None else read_task(task) for task in given]
        fields = None if self._fields is None else FieldBatch(len(tasks))
        for index, (world, task) in enumerate(zip(worlds, tasks, strict=True)):
            places = [values["motions"][index, :2], values["goals"][index]]
            places += [] if task is None else [task.start[:2], task.goal]
            if not (np.abs(places) <= np.divide(world.size, 2)).all():
                raise ValueError(
                    f"tasks, motions and goals of the state must lie in {world.room}, got {places}"
                )
            if task is not None and fields is not None:
                fields[index] = distance_field(world, self._config.collision_distance, task.goal)
        starts = np.array([(0.0, 0.0, 0.0) if task is None else task.start for task in tasks])
        starts[:, 2] = [math.remainder(heading, math.tau) for heading in starts[:, 2]]
        load_walkers = self.walkers.read(state.get("walkers", {}), worlds)
        load_drives = self.drives.read(state.get("drives", {}), starts)
        # The compiled loops use the number of steps as an index, unchecked.
        steps, most = values["steps"], self._config.max_steps
        if steps.min() < 0 or steps.max() > most:
            raise ValueError(f"steps of the state must be in [0, {most}], got {steps.tolist()}")
        last = int(steps.max())
        trails = read_array(state, "trails", np.zeros((len(tasks), last + 1, 2)))
        if self.memory is not None:
            self.memory.load_state_dict(state.get("memory", {}))
        self.trails = grown(self.trails, last + 1)
        self.trails[:, : last + 1] = trails
        for name, array in arrays.items():
            array[...] = values[name]
        self.tasks, self._fields = tasks, fields
        for index, world in enumerate(worlds):
            self.worlds[index] = world
        load_walkers()
        load_drives()

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of the episodes by name."""
        robot = self._config.robot
        return {
            # The name in saved states.
            **{"ways" if n == "remaining" else n: a for n, a in self.episodes._asdict().items()},
            "running": self.running,
            "observations": self.observations,
            **({} if robot.wheel_acceleration is None else {"commands": self.drives.commands}),
            "ranges": self.ranges,
            **({} if self.noise is None else self.noise.arrays()),
        }

    def _pay_by_function(self, running: NDArray[np.bool_]) -> None:
        """Add the rewards of the user's function, robot by robot."""
        episodes = self.episodes
        for index in np.flatnonzero(running).tolist():
            outcome = StepOutcome(
                float(episodes.remaining[1, index]),
                float(episodes.remaining[0, index]),
                bool(episodes.flags[0, index]),
                bool(episodes.flags[1, index]),
                float(episodes.clearances[index]),
                *episodes.motions[index, 3:].tolist(),
            )
            episodes.numbers[REWARD : REWARD + 4, index] += read_terms(
                self._config.reward_function(outcome)
            )

    def sense(self, chosen: NDArray[np.bool_], rngs: Sequence[np.random.Generator]) -> None:
        """Sense the worlds, and build the observations of the chosen robots, ``[N]``."""
        lidar, ranges = self._lidar, self.ranges
        lidar.cast_all(self.episodes.motions, chosen, self.worlds.arrays, ranges)
        if lidar.is_noisy:
            for index in np.flatnonzero(chosen).tolist():
                lidar.disturb(ranges[index], rngs[index])
        held = self._by_odometry()
        paths = _NO_PATHS
        if self.memory is not None:
            seen = self.walkers.without(self.episodes.motions, lidar, ranges)
            paths = self.memory.remember(held.motions, held.goals, seen, chosen)
        median = lidar.reduction == "median"
        observe_all(
            held.motions,
            held.goals,
            held.numbers[DISTANCE],
            held.steps == 0,
            chosen,
            ranges,
            median,
            self._scales,
            paths,
            lidar.sectors,
            self._config.history,
            self.observations,
        )

    def moments(self) -> NDArray[np.float64]:
        """What a goal in hindsight needs of the present, ``[N, 9 + rays]``.

        Position (x, y), the room's size, pose and speeds by odometry, and the range of each ray [m,
        m/s, rad], of which a ray that met a walker has the greatest, as in the robot's map.
        """
        motions, held = self.episodes.motions, self._by_odometry()
        sizes = np.array([world.size for world in self.worlds])
        seen = self.walkers.without(motions, self._lidar, self.ranges)
        return np.concatenate((motions[:, :2], sizes, held.motions, seen), axis=1)

    def _by_odometry(self) -> EpisodeArrays:
        """The episodes with poses, speeds and distances by the robots' odometry."""
        if self.noise is None or not self.noise.has_odometry:
            return self.episodes
        motions = self.noise.odometry
        self._held[DISTANCE] = np.hypot(*(self.episodes.goals - motions[:, :2]).T)
        return self.episodes._replace(motions=motions, numbers=self._held)

    def trail(self, index: int) -> list[tuple[float, float]]:
        """Positions (x, y) of a robot's episode so far [m]."""
        rows = self.trails[index, : self.episodes.steps[index] + 1]
        return [(x, y) for x, y in rows.tolist()]

    def snapshots(self) -> tuple[Callable[[], NDArray[np.uint8]], ...]:
        """Functions that render each robot's room as it is now from above, ``[H, W, 3]``."""
        # Imported here because training does not render.
        from mpfa_envs.scene.scene import render_scene

        return tuple(
            partial(
                render_scene,
                self.worlds[index],
                robot=self._config.robot,
                pose=(x, y, heading),
                goal=tuple(self.episodes.goals[index].tolist()),
                goal_radius=self._config.goal_radius,
                trail=self.trail(index),
                rays=(self._lidar.angles, self.ranges[index].copy()),
                sketch=None if self.memory is None else self.memory.sketch(index, x, y),
                walkers=self.walkers.of(index),
            )
            for index, (x, y, heading) in enumerate(self.episodes.motions[:, :3].tolist())
        )
