"""The arguments of the navigation task, which one robot's and many robots' environments share."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

import numpy as np
from gymnasium.spaces import Box as BoxSpace

from mpfa_envs.checks import check_count, check_number, check_positive, check_share
from mpfa_envs.lidar import Lidar
from mpfa_envs.live_view import LiveView, RenderMode
from mpfa_envs.noise import NoisyMotion, RobotNoise, resolve_noise
from mpfa_envs.observation import Memory, observation_bounds, observation_slices
from mpfa_envs.reward import RewardFunction, resolve_reward
from mpfa_envs.robot import RobotModel, resolve_collision_distance, resolve_robot
from mpfa_envs.worlds import World

Physics = Literal["kinematic", "wheels"]
"""How the robot moves."""
Progress = Literal["straight_line", "shortest_path", "none"]
"""What the reward's progress is measured along."""

_MOST_STEPS: Final = 1_000_000
"""No episode has more time steps: a policy that never arrives must come to an end."""

PAPER_TASK: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "action_repeat": 1,
        "progress_scale": 15.0,
        "collision_distance": 0.35,
        "closeness_distance": 0.35,
        "detour_chance": 0.0,
    }
)
"""Arguments of :class:`~mpfa_envs.NavigationEnv` for the paper's task, for its TurtleBot2.

The paper gives no ε_p; its curves, about 0.5 reward a step of 0.05 m at most, suggest 10 to 20.
"""


class TaskArguments(LiveView):
    """Checks the arguments of :class:`~mpfa_envs.NavigationEnv` and keeps them as attributes."""

    def _set_arguments(
        self,
        *,
        robot: str | RobotModel,
        physics: Physics,
        max_steps: int,
        time_step: float,
        action_repeat: int,
        goal_radius: float,
        collision_distance: float | Literal["contact"] | None,
        progress_scale: float,
        progress: Progress,
        reward: RewardFunction | None,
        lidar: Mapping[str, Any] | None,
        memory: Memory,
        history: int,
        noise: RobotNoise | Mapping[str, Any] | None,
        closeness_distance: float | None,
        min_goal_distance: float,
        detour_chance: float,
        render_mode: RenderMode | None,
    ) -> None:
        """Check them all; the first that is out of its range is named."""
        self.robot = resolve_robot(robot)
        if physics not in get_args(Physics):
            raise ValueError(f"physics must be one of {get_args(Physics)}, got {physics!r}")
        if progress not in get_args(Progress):
            raise ValueError(f"progress must be one of {get_args(Progress)}, got {progress!r}")
        scale = check_number("progress_scale", progress_scale)
        self.progress = progress
        self.reward = resolve_reward(reward, progress=progress, progress_scale=scale)
        self.physics = physics
        self.memory: Memory = memory
        self.history = history
        self.max_steps = check_count("max_steps", max_steps, most=_MOST_STEPS)
        self.time_step = check_positive("time_step", time_step)
        self.action_repeat = check_count("action_repeat", action_repeat)
        self._set_view(render_mode, self.time_step, self.action_repeat)
        self.goal_radius = check_positive("goal_radius", goal_radius)
        self.min_goal_distance = check_positive("min_goal_distance", min_goal_distance)
        if not self.min_goal_distance > self.goal_radius:
            raise ValueError(
                f"min_goal_distance must be above goal_radius = {goal_radius}, "
                f"got {min_goal_distance}"
            )
        self.detour_chance = check_share("detour_chance", detour_chance)
        self.collision_distance = resolve_collision_distance(collision_distance, self.robot)
        self._check_step()
        self.closeness_distance = (
            self.robot.collision_distance
            if closeness_distance is None
            else check_positive("closeness_distance", closeness_distance)
        )
        self.noise = resolve_noise(noise)
        if not isinstance(lidar, Mapping | None):
            raise ValueError(f"lidar must hold arguments of Lidar, got {lidar!r}")
        self._lidar_arguments: dict[str, Any] = dict(lidar or {})
        for name, value in (("noise", self.noise.range_noise), ("dropout", self.noise.dropout)):
            if value > 0.0:
                if name in self._lidar_arguments:
                    raise ValueError(f"lidar must not hold {name!r} beside noise={self.noise}")
                self._lidar_arguments[name] = value

    def _check_step(self) -> None:
        """Refuse time steps in which a robot could get through a wall.

        Collisions are looked for at the ends of time steps. Of a robot that does not drive farther
        than the collision distance in one, the center cannot get into an obstacle before.
        """
        robot = self.robot
        fastest = max(abs(robot.min_wheel_speed), abs(robot.max_wheel_speed))
        if self.time_step * fastest > self.collision_distance:
            raise ValueError(
                f"time_step must be at most {self.collision_distance / fastest:.4g} s, in which "
                f"{robot.name!r} drives no farther than collision_distance = "
                f"{self.collision_distance} m at its fastest, got {self.time_step}"
            )

    def _make_lidar(self, world: World) -> Lidar:
        """The lidar in a world."""
        try:
            return Lidar(world, **self._lidar_arguments)
        except TypeError as error:
            raise ValueError(
                f"lidar must hold arguments of Lidar, got {self._lidar_arguments!r}: {error}"
            ) from error

    def _make_noise(self, robots: int) -> NoisyMotion | None:
        """What disturbs the motion of some robots, if anything does."""
        if not self.noise.is_in_motion:
            return None
        base, step = self.robot.wheel_base, self.time_step
        return NoisyMotion(self.noise, robots, wheel_base=base, time_step=step)

    def _make_spaces(
        self, sectors: int, diagonal: float
    ) -> tuple[BoxSpace[np.float32], BoxSpace[np.float32]]:
        """The spaces of one robot's observations and actions.

        Args:
            sectors: Number of sectors of the lidar.
            diagonal: Longest distance in a room [m].
        """
        remembered: Any = {"memory": self.memory, "history": self.history}
        self.observation_slices = observation_slices(sectors, **remembered)
        low, high = observation_bounds(sectors, diagonal, **remembered)
        return BoxSpace(low, high, dtype=np.float32), BoxSpace(-1.0, 1.0, (2,), np.float32)
