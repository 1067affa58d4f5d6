"""Many robots in their worlds: moved, sensed and rewarded together by compiled loops."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

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
from mpfa_envs.env.team import Team
from mpfa_envs.paths.distance import FieldArrays
from mpfa_envs.robots.drives import make_drives
from mpfa_envs.robots.motion_loops import scale_actions
from mpfa_envs.sensing.map_memory import MapMemory
from mpfa_envs.sensing.observation import (
    FLAGS,
    INFO_TYPES,
    NUMBERS,
    lidar_pose,
    look_from,
    observe_all,
)
from mpfa_envs.sensing.sensors import Sight, sense_with, write_sensed
from mpfa_envs.sensing.standing import standing_hits, standing_sectors
from mpfa_envs.tasks.reward import StepOutcome, payments_of, read_terms
from mpfa_envs.walkers.batch import WalkerBatch
from mpfa_envs.worlds.arrays import grown
from mpfa_envs.worlds.batch import WorldBatch
from mpfa_envs.worlds.walker import no_encounters

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from mpfa_envs.env.config import TaskConfig
    from mpfa_envs.env.episodes import Episode
    from mpfa_envs.safety.filter import SafetyFilter
    from mpfa_envs.sensing.lidar import Lidar
    from mpfa_envs.worlds.world import Task, World

_TRAIL = 500
"""Time steps that trails have room for at first."""
_NO_PATHS = np.zeros((0, 3))
_MASKS = tuple(f"_{name}" for name in INFO_TYPES)
_INFO_KEYS = (*FLAGS, *NUMBERS, *_MASKS)


class RobotBatch:
    """The state of many robots, and its changes."""

    def __init__(
        self, config: TaskConfig, lidar: Lidar, worlds: Sequence[World], team: int = 1
    ) -> None:
        count = len(worlds)
        self._config = config
        self._filter: SafetyFilter | None = None
        self._lidar = lidar
        self.tasks: list[Task | None] = [None] * count
        """Start and goal of each robot's episode; None before the first."""
        radius = config.robot.radius
        self.worlds = WorldBatch(worlds, mates=team - 1, radius=radius)
        """The present world of each robot."""
        self.team = Team(self.worlds, team, radius) if team > 1 else None
        """The other robots in these, if there are any."""
        self.walkers = WalkerBatch(self.worlds, radius=radius, time_step=config.time_step)
        """The walkers around each robot."""
        self._fields = FieldArrays.empty(count) if config.progress == "shortest_path" else None
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
        self._most_steps = 0
        """At least as many time steps as any episode has so far."""
        self.running = np.zeros(count, dtype=np.bool_)
        """True if an episode has begun and not ended, ``[N]``."""
        self.trails = np.zeros((count, min(config.max_steps, _TRAIL) + 1, 4))
        """Positions since the start of the episode [m], and the wheel speeds that actions asked for
        until there [m/s], ``[N, steps, 4]``."""
        self.ranges = np.zeros((count, lidar.angles.size))
        """Range of each ray [m], ``[N, rays]``."""
        self.memory = MapMemory(count, config.robot, lidar) if config.memory == "map" else None
        """The robots' maps, if they have any."""
        width = max(part.stop for part in config.observation_slices.values())
        self.observations = np.zeros((count, width), dtype=np.float32)
        """The last observations, ``[N, O]``."""
        self._own = width - sum(sensor.width for sensor in config.sensors.values())
        self.drives = make_drives(config.physics, config.robot, count, time_step=config.time_step)
        """The physics."""
        self.noise = config.make_noise(count)
        """Errors of the robots' motion, if there are any."""
        self._orders = config.make_orders(count)
        robot = config.robot
        self._lengths = (
            robot.radius,
            config.collision_distance,
            config.goal_radius,
            config.time_step,
        )
        self._limits = robot.wheel_limits
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
            self._fields = self._fields.with_field(index, episode.field)
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
        self.trails[index, 0, :2] = x, y
        self.running[index] = True
        if self.noise is not None:
            self.noise.begin(index, (x, y, heading), rng)
        if self._orders is not None:
            self._orders.begin(index, rng)
        if self.memory is not None:
            plan = episode.world if self._config.plan == "known" else None
            self.memory.begin(index, episode.world, plan=plan)

    def wheel_speeds(self, actions: NDArray[np.float32]) -> NDArray[np.float64]:
        """Speeds [m/s] of the left and the right wheel, ``[N, 2]``, by actions of that shape."""
        values = np.ascontiguousarray(actions, dtype=np.float64)
        if values.shape != (len(self.tasks), 2):
            raise ValueError(f"actions must have shape ({len(self.tasks)}, 2), got {values.shape}")
        speeds = np.empty_like(values)
        if not scale_actions(values, self._limits, speeds):
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
        # By a mask, `copyto` takes a third of the time of an assignment.
        np.copyto(episodes.numbers[REWARD : REWARD + 4], 0.0, where=moving)
        self._most_steps += self._config.action_repeat
        if self._most_steps >= self.trails.shape[1]:
            self._most_steps = int(episodes.steps.max()) + self._config.action_repeat
        if self._most_steps >= self.trails.shape[1]:
            self.trails = grown(self.trails, 2 * self._most_steps + 1)
        noise = self.noise
        disturb = None if noise is None else partial(noise.drive, running=running, rngs=rngs)
        for _ in range(self._config.action_repeat):
            self.walkers.move(running, episodes.motions)
            due = speeds if self._orders is None else self._orders.arriving(speeds, running)
            self.drives.move(episodes.motions, running, due, disturb)
            if self.team is not None:
                self.team.place(episodes.motions)
            if noise is not None:
                noise.measure(episodes.motions, running)
            self.walkers.count_encounters(episodes.motions, running, episodes.numbers[ENCOUNTERS:])
            judge(
                episodes,
                worlds,
                running,
                speeds,
                self.trails,
                self._lengths,
                self._config.max_steps,
            )
            if self._fields is not None:
                measure_remaining(episodes, running, self._fields)
            if self._payments is None:
                self._pay_by_function(running, rngs)
            if not settle(episodes, running, self._payments or (0.0, 0.0, 0.0, 0.0)):
                break
        np.copyto(self.running, running, where=moving)

    def driven(self, index: int) -> NDArray[np.float64]:
        """The wheel speeds that each action of a robot's episode asked for [m/s], ``[A, 2]``."""
        steps = self.episodes.steps[index]
        return self.trails[index, 1 : steps + 1 : self._config.action_repeat, 2:].copy()

    def drive_again(
        self,
        episodes: Sequence[Episode],
        driven: Sequence[NDArray[np.float64]],  # by robot, [A, 2]
        rngs: Sequence[np.random.Generator],
        places: NDArray[np.float64],  # where they come to (x, y) [m], [N, 2]
    ) -> None:
        """Begin episodes, and drive them again; an error shuts the drives down."""
        try:
            if episodes:
                self._drive_again(episodes, driven, rngs)
            # Robots that share a physics server may be off by a millimeter.
            here = self.episodes.motions[:, :2]
            if not np.allclose(np.reshape(places, here.shape), here, rtol=0, atol=0.01):
                raise ValueError(
                    "state cannot be loaded: its episodes end elsewhere when they are driven "
                    "again, as it was changed or is of another version; begin new ones with reset()"
                )
        except BaseException:
            self.drives.close()
            raise

    def _drive_again(
        self,
        episodes: Sequence[Episode],
        driven: Sequence[NDArray[np.float64]],
        rngs: Sequence[np.random.Generator],
    ) -> None:
        """Begin episodes, and drive them with the wheel speeds [m/s] of their actions."""
        counts = np.array([len(speeds) for speeds in driven])
        last = int(counts.max())
        table = np.zeros((last, len(driven), 2))
        for index, speeds in enumerate(driven):
            table[last - counts[index] :, index] = speeds
        # All end at once: in a shared physics server, a robot that waited would roll on.
        for step in range(last + 1):
            starting, moving = counts == last - step, counts > last - step - 1
            for index in np.flatnonzero(starting).tolist():
                self.begin(index, episodes[index], rngs[index])
            if starting.any():
                self.sense(starting, rngs)
            if step == last:
                break
            if (ended := moving & ~self.running).any():
                robots = np.flatnonzero(ended).tolist()
                raise ValueError(
                    f"speeds of the state continue after the episodes of robots {robots}"
                )
            self.advance(table[step], moving, rngs)
            self.sense(moving, rngs)

    def _pay_by_function(
        self, running: NDArray[np.bool_], rngs: Sequence[np.random.Generator]
    ) -> None:
        """Add the rewards of the user's function, robot by robot."""
        episodes = self.episodes
        sight = Sight(episodes.motions, running, self.worlds.arrays, rngs)
        for index in np.flatnonzero(running).tolist():
            outcome = StepOutcome(
                float(episodes.remaining[1, index]),
                float(episodes.remaining[0, index]),
                bool(episodes.flags[0, index]),
                bool(episodes.flags[1, index]),
                float(episodes.clearances[index]),
                float(episodes.motions[index, 3]),
                float(episodes.motions[index, 4]),
                sense=partial(sense_with, self._config.sensors, index, sight),
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
        here, held = self._motions()
        seen, paths = self._from(here, held, chosen), _NO_PATHS
        if self.memory is not None:
            standing = self.walkers.without(self.episodes.motions, lidar, ranges)
            paths = self.memory.remember(held, self.episodes.goals, standing, chosen, taken=here)
        median = lidar.reduction == "median"
        observe_all(
            held,
            self.episodes.goals,
            self._distances(held),
            self.episodes.steps == 0,
            chosen,
            seen,
            median,
            self._scales,
            paths,
            lidar.sectors,
            self._config.history,
            self.observations[:, : self._own],
        )
        if sensors := self._config.sensors:
            motions = self.episodes.motions.copy()
            sight = Sight(motions, chosen.copy(), self.worlds.arrays, rngs)
            write_sensed(sensors, sight, self.observations[:, self._own :])

    def measurements(self) -> NDArray[np.float64]:
        """Return the state that hindsight relabeling needs, ``[N, 12 + rays]``.

        Position (x, y), the world's size, pose and speeds by odometry as observed, the pose where
        the scan was taken, and the range of each ray [m, m/s, rad], of which a ray that met a
        walker has the greatest, as in the robot's map.
        """
        motions = self.episodes.motions
        here, held = self._motions()
        sizes = np.array([world.size for world in self.worlds])
        seen = self.walkers.without(motions, self._lidar, self.ranges)
        return np.concatenate((motions[:, :2], sizes, held, here[:, :3], seen), axis=1)

    def standing(self, chosen: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Sectors in which the chosen robots see known walls alone, ``[N, sectors]``."""
        (here, held), lidar = self._motions(), self._lidar
        view, rows = math.radians(lidar.field_of_view), []
        for index in chosen.tolist():
            taken, place = (lidar_pose(at[index], *lidar.mount) for at in (here, held))
            scan, far = (taken, lidar.angles, self.ranges[index]), lidar.max_range
            hits = standing_hits(self.worlds[index], (0.0, 0.0, 0.0), *scan, far)
            rows.append(standing_sectors(hits, *scan, far, place, view, lidar.sectors))
        return np.array(rows).reshape(len(rows), lidar.sectors)

    def make_filter(self) -> SafetyFilter:
        """The filter of the task, each time the same one."""
        if self._filter is None:
            self._filter = self._config.make_filter()
        return self._filter

    def measured(self) -> NDArray[np.float64]:
        """Motions by odometry when the next orders act, ``[N, 5]``."""
        return self._motions()[1]

    def _motions(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """By odometry, motions now and when the next orders act, ``[N, 5]``."""
        here = self.episodes.motions if self.noise is None else self.noise.odometry
        return here, here if self._orders is None else self._orders.ahead(here)

    def _distances(self, motions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances of the goals [m], ``[N]``."""
        if motions is self.episodes.motions:
            return self.episodes.numbers[DISTANCE]
        return np.hypot(*(self.episodes.goals - motions[:, :2]).T)

    def _from(
        self,
        here: NDArray[np.float64],
        held: NDArray[np.float64],
        chosen: NDArray[np.bool_],
    ) -> NDArray[np.float64]:
        """Ranges of the rays as they are where the next orders act [m], ``[N, rays]``."""
        if here is held:
            return self.ranges
        lidar, seen = self._lidar, np.empty_like(self.ranges)
        view = math.radians(lidar.field_of_view)
        for index in np.flatnonzero(chosen).tolist():
            look_from(
                lidar_pose(held[index], lidar.mount[0], lidar.mount[1]),
                lidar.angles,
                self.ranges[index],
                lidar_pose(here[index], lidar.mount[0], lidar.mount[1]),
                lidar.max_range,
                view,
                seen[index],
            )
        return seen

    def infos(self, chosen: NDArray[np.bool_] | None) -> dict[str, Any]:
        """The infos of the chosen robots, or of all: an array for each key, and its mask."""
        # Rows of one table, as copies one by one would take longer than all the rest.
        masks = np.empty((len(_MASKS), len(self.tasks)), dtype=np.bool_)
        masks[:] = True if chosen is None else chosen
        rows = *self.episodes.flags.copy(), *self.episodes.numbers.copy(), *masks
        return dict(zip(_INFO_KEYS, rows, strict=True))

    def final_infos(self, ended: NDArray[np.bool_]) -> dict[str, Any]:
        """The last observations and infos of the robots whose episodes have ended, ``[N]``."""
        seen = np.full(len(ended), None, dtype=object)
        for index in np.flatnonzero(ended).tolist():
            seen[index] = self.observations[index].copy()
        infos = self.infos(ended)
        return {"final_obs": seen, "_final_obs": ended, "final_info": infos, "_final_info": ended}

    def trail(self, index: int) -> list[tuple[float, float]]:
        """Positions (x, y) of a robot's episode so far [m]."""
        rows = self.trails[index, : self.episodes.steps[index] + 1, :2]
        return [(x, y) for x, y in rows.tolist()]

    def moving(self, index: int) -> NDArray[np.float64]:
        """What moves around a robot: (x, y), speeds in both directions, radius, ``[K, 5]``."""
        walkers = self.walkers.of(index)
        if self.team is None:
            return walkers
        return np.concatenate((walkers, self.team.of(index, self.episodes.motions)))

    def snapshots(self) -> tuple[Callable[[], NDArray[np.uint8]], ...]:
        """Functions that render each robot's world as it is now from above, ``[H, W, 3]``."""
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
                rays=self._lidar.around_center(self.ranges[index].copy()),
                known_map=None if self.memory is None else self.memory.known_map(index, x, y),
                walkers=self.moving(index),
            )
            for index, (x, y, heading) in enumerate(self.episodes.motions[:, :3].tolist())
        )
