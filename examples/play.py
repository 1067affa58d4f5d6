"""Race a policy by keyboard: both robots start in the same room, and the first to arrive wins.

    python examples/play.py                                td3-rooms, which comes with the package
    python examples/play.py runs/demo --worlds mazes:test
    python examples/play.py --worlds D --speed 2           twice as fast as real time
    python examples/play.py --robot turtlebot4             both drive another robot

Drive with the arrow keys or WASD: up is full speed ahead, left and right turn, both together make
a curve. Without a key the robot stands, and down reverses; the paper's robot, which can do neither,
drives on at its lowest speed. Your robot is black, with its lidar; the policy's is vermilion; they
pass through each other. N starts the next room, Escape ends. It needs pygame (extra ``live``).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence
from contextlib import closing
from typing import Any, Literal

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from mpfa_envs import (
    POLICIES,
    NavigationEnv,
    Policy,
    RobotModel,
    TaskConfig,
    WorldTask,
    load_policy,
)
from mpfa_envs.scene.scene import Window, render_scene
from training.evaluating import on_robot, tasks_of
from training.options import add_robot
from training.worlds import parse_worlds

POLICY = "td3-rooms"
LETTERS = {"w": "up", "a": "left", "s": "down", "d": "right"}
_PAUSE = 2.0
"""For which the end of a race is shown [s]."""
Winner = Literal["you", "policy", "nobody"]


def action_of(keys: Iterable[str], robot: RobotModel) -> NDArray[np.float32]:
    """Return the wheel speeds of some held keys, in [-1, 1], ``[2]``."""
    held = {LETTERS.get(key, key) for key in keys}
    turn = ("right" in held) - ("left" in held)
    slow, fast = robot.min_wheel_speed, robot.max_wheel_speed
    rest = -(fast + slow) / (fast - slow) if robot.can_stop else -1.0
    if not turn:
        ahead = 1.0 if "up" in held else -1.0 if "down" in held else rest
        return np.array([ahead, ahead], dtype=np.float32)
    if "up" in held:
        outer, inner = 1.0, 0.3
    elif robot.can_stop:
        outer, inner = rest + 0.3, rest - 0.3
    else:
        # As narrow as it can be.
        outer, inner = 1.0, -1.0
    return np.array([outer, inner] if turn > 0 else [inner, outer], dtype=np.float32)


class Racer:
    """A robot that drives a task, with arguments of :class:`~mpfa_envs.NavigationEnv`."""

    def __init__(self, episode: WorldTask, **env_arguments: Any) -> None:
        self.env = NavigationEnv(
            **{**env_arguments, **episode.limit(env_arguments), "world": episode.world}
        )
        self.observation, self.info = self.env.reset(seed=0, options=episode.task._asdict())
        self.running = True

    @property
    def pose(self) -> tuple[float, float, float]:
        """Pose of the robot (x, y, heading) [m, m, rad]."""
        return self.info["x"], self.info["y"], self.info["heading"]

    @property
    def arrival(self) -> float:
        """When it was at the goal [s]; infinite if it was not."""
        return float(self.info["sim_time"]) if self.info["success"] else math.inf

    def drive(self, action: NDArray[np.float32]) -> None:
        """Hold an action for one step; nothing happens once its way has ended."""
        if self.running:
            self.observation, _, terminated, truncated, self.info = self.env.step(action)
            self.running = not (terminated or truncated)


def race(policy: Policy, episode: WorldTask, window: Window, **env_arguments: Any) -> Winner | None:
    """Drive one race; return the first at the goal, None if the player left."""
    arguments = {**policy.env_arguments, "contact": True, **env_arguments}
    keep_off = TaskConfig(**arguments).make_filter()
    you, rival = Racer(episode, **arguments), Racer(episode, **arguments)
    with closing(you.env), closing(rival.env):
        while you.running or rival.running:
            if not window.show(picture_of(you, rival)) or "n" in window.pressed:
                return None
            you.drive(action_of(window.keys, you.env.config.robot))
            rival.drive(keep_off(rival.observation, policy(rival.observation)))
            # Whoever arrives ends the race for the other, unless both do in this step.
            if min(you.arrival, rival.arrival) < math.inf:
                break
        window.show(picture_of(you, rival))
        if you.arrival == rival.arrival:
            return "nobody"
        return "you" if you.arrival < rival.arrival else "policy"


def picture_of(you: Racer, rival: Racer) -> NDArray[np.uint8]:
    """The room with both robots, shape ``[height, width, 3]``."""
    env = you.env
    walkers = env.walkers
    ranges = env.lidar.cast(*you.pose, moving=walkers[:, [0, 1, 4]])
    assert env.task is not None
    return render_scene(
        env.world,
        robot=env.config.robot,
        pose=you.pose,
        goal=env.task.goal,
        goal_radius=env.config.goal_radius,
        trail=env.trail,
        rays=(env.lidar.angles, ranges),
        walkers=walkers,
        rival=(rival.pose, rival.env.trail),
        size=640,
    )


def main(arguments: Sequence[str] | None = None) -> dict[str, int]:
    """Race until the rooms or the player's patience end; print and return the races won by each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "path",
        nargs="?",
        default=POLICY,
        help=f"policy.npz, the folder of a run, or {', '.join(POLICIES)} (default: {POLICY})",
    )
    parser.add_argument(
        "--worlds",
        nargs="+",
        default=["rooms:test"],
        help="as in evaluate.py (default: rooms:test)",
    )
    add_robot(parser, "that of the policy")
    parser.add_argument("--races", type=int, default=10, help="at most (default: 10)")
    parser.add_argument("--seed", type=int, default=0, help="seed of starts and goals (default: 0)")
    parser.add_argument("--speed", type=float, default=1.0, help="times real time (default: 1)")
    options = parser.parse_args(arguments)
    try:
        policy = on_robot(load_policy(options.path), options.robot)
        names = parse_worlds(options.worlds)
        tasks = tasks_of(policy, names, episodes=options.races, seed=options.seed)
        step = TaskConfig(**policy.env_arguments).action_time
        window = Window("arrows or WASD: drive   N: next room   Esc: end", fps=options.speed / step)
    except (ValueError, OSError, DependencyNotInstalled) as error:
        parser.error(str(error))
    if window.is_hidden():
        parser.error("there is no screen to show a window on: evaluate.py writes pictures")
    score = {"you": 0, "policy": 0, "nobody": 0}
    with closing(window):
        for task in tasks[: options.races]:
            winner = race(policy, task, window, physics="kinematic")
            if window.closed:
                break
            if winner is not None:
                score[winner] += 1
                print(f"{task.world.name}: {winner} first")
    print(", ".join(f"{name} {count}" for name, count in score.items()))
    return score


if __name__ == "__main__":
    main()
