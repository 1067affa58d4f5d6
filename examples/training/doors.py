"""The end of a training: doors hardly wider than the robot, with orders in time and late."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from mpfa_envs import Box, Task, World, load_policy, run_tasks
from mpfa_envs.robots.resolve import resolve_robot
from mpfa_envs.tasks.sampling import WorldTask
from training import files
from training.evaluating import filtered

if TYPE_CHECKING:
    from pathlib import Path

    from mpfa_envs.robots.model import RobotModel
    from training.settings.train import TrainSettings

_SPARE: Final = 0.05
"""Room on each side of the robot in the door [m]."""
_LATE: Final = 0.0, 0.1, 0.3
"""Times from a scan to the moment at which the wheels take the order [s]."""
_TASKS: Final = 10


def door_tasks(robot: RobotModel) -> list[WorldTask]:
    """Tasks through a door between two rooms, from both sides and in all directions."""
    edge, size = robot.radius + _SPARE, (12.0, 8.0)
    wall = Box(-0.1, edge, 0.1, 4.0), Box(-0.1, -4.0, 0.1, -edge)
    world = World(name="a narrow door", size=size, boxes=wall)
    tasks = []
    for number in range(_TASKS):
        side, across = (-1.0) ** number, 0.6 * (number - 4.5)
        start = (-3.0 * side, across, 2.4 * number)
        tasks.append(WorldTask(world, Task(start, (3.0 * side, -across))))
    return tasks


def is_asked(settings: TrainSettings) -> bool:
    """Return True if a run trains a policy with a map behind the filter, as one for a robot."""
    task = settings.environment
    return task.filter == 1.0 and task.memory == "map"


def drive_through_doors(folder: Path) -> str:
    """Drive the policy of a run as a robot's pilot would; return a sentence of how it went."""
    policy = load_policy(folder / files.POLICY)
    robot = resolve_robot(policy.env_arguments["robot"])
    tasks, reached = door_tasks(robot), []
    for latency in _LATE:
        task: dict[str, Any] = {"physics": "kinematic", "latency": latency}
        driver = filtered(policy, rescue=True, **task)
        results = run_tasks(driver, tasks, **policy.env_arguments | task)
        reached.append(sum(each.success for each in results))
    counts = ", ".join(str(each) for each in reached)
    late = ", ".join(f"{each:g}" for each in _LATE)
    return (
        f"doors 5 cm wider than the robot on each side: {counts} of {_TASKS} passed with orders "
        f"{late} s late"
    )
