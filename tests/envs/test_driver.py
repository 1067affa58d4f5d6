"""Drivers on a robot: a pilot tells them what the environment tells them, and planners drive."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from mpfa_envs import NavigationEnv, TaskConfig, VectorNavigationEnv, make_pilot
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.driver import Errand, Senses
from mpfa_envs.planners.piloted import card_of
from mpfa_envs.worlds.world import World

TASK: dict[str, Any] = {"robot": "kobuki", "physics": "kinematic", "memory": "map"}


class Told:
    """Drives ahead, and keeps what it is told."""

    def __init__(self) -> None:
        self.errands: list[Errand] = []
        self.senses: list[Senses] = []

    def begin(self, robot: int, errand: Errand) -> None:
        self.errands.append(errand)

    def drive(self, senses: Senses) -> np.ndarray:
        self.senses.append(senses)
        return np.full((1, 2), 0.4, np.float32)


def scan_of(env: VectorNavigationEnv) -> Scan:
    """What a robot in the place of the environment's would measure, right to left."""
    lidar = TaskConfig(**TASK).make_lidar(env.worlds[0])
    ranges, angles = lidar.cast(*env.poses[0].tolist()), lidar.angles
    return Scan(angles[-1], angles[0] - angles[1], ranges[::-1].copy())


def test_a_pilot_tells_a_driver_what_the_environment_tells_it() -> None:
    there, here = Told(), Told()
    env = VectorNavigationEnv(1, world="C", **TASK)
    env.reset(seed=3)
    there.begin(0, env.errand(0))
    errand = there.errands[0]
    pilot = Pilot(card_of(env.config), here, clearance=0.03, map_size=env.worlds[0].size[0])
    pilot.begin(errand.goal, map_center=(0.0, 0.0))
    for _ in range(8):
        actions = there.drive(env.senses(np.zeros(1, np.int64)))
        motion = env.motions[0].tolist()
        pilot.decide(scan_of(env), tuple(motion[:3]), tuple(motion[3:]))
        ours, theirs = here.senses[-1], there.senses[-1]
        for name in ("observations", "motions", "poses", "goals", "robots"):
            expected = getattr(theirs, name)
            np.testing.assert_allclose(getattr(ours, name), expected, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(ours.states[:, :1], ours.observations[:, None])
        assert ours.maps is not None and theirs.maps is not None
        np.testing.assert_array_equal(ours.maps.levels, theirs.maps.levels)
        np.testing.assert_allclose(ours.maps.origins, theirs.maps.origins, atol=1e-9)
        env.step(actions)
    assert len(here.errands) == 1
    told = here.errands[0]
    assert told.start == pytest.approx(errand.start) and told.world is None
    assert told[1:5] == errand[1:5] and told.map_shape == errand.map_shape
    assert told.make_filter() is told.make_filter() is pilot._keep
    env.close()


def test_a_driver_is_told_of_each_drive_and_of_a_goal_that_moves() -> None:
    driver = Told()
    pilot = Pilot(card_of(TaskConfig(**TASK)), driver, latency=0.3, clearance=0.03)
    plan = World(name="hall", size=(12.0, 8.0))
    scan = Scan(-math.pi, math.pi / 180.0, np.full(360, 3.0), 0.05, 10.0)
    still: tuple[Any, ...] = (scan, (0.0, 0.0, 0.0), (0.3, 0.0))
    pilot.begin((3.0, 1.0))
    pilot.observe(*still)
    pilot.decide(*still)
    pilot.move_goal((3.2, 1.0))
    pilot.decide(*still)
    assert [errand.goal for errand in driver.errands] == [(3.0, 1.0)]
    assert driver.senses[-1].goals.tolist() == [[3.2, 1.0]]
    # Late orders: some states, and the pose when the order acts.
    assert driver.senses[-1].states.shape[1] > 1 and driver.senses[-1].motions[0, 0] > 0.03
    pilot.begin((2.0, 0.0), plan=plan, plan_pose=(1.0, 0.5, 0.1))
    pilot.decide(*still)
    assert driver.errands[1].world is plan and driver.errands[1].world_pose == (1.0, 0.5, 0.1)
    pilot.move_plan((1.5, 0.5, 0.1))
    pilot.decide(*still)
    assert [errand.world_pose[0] for errand in driver.errands[1:]] == [1.0, 1.5]


@pytest.mark.parametrize("name", ["mpc", "dwa", "astar"])
@pytest.mark.parametrize("late", [0.0, 0.3])
def test_planners_drive_a_robot_without_a_policy(name: str, late: float) -> None:
    env = NavigationEnv(world="B", contact=True, **TASK | {"latency": late})
    env.reset(seed=4)
    assert env.task is not None
    pilot = make_pilot(name, robot="kobuki", latency=late)
    plan = {} if name != "astar" else {"plan": env.world}
    pilot.begin(env.task.goal, **plan)
    for step in range(150):
        x, y, heading = env.motion[:3]
        ranges, angles = env.lidar.cast(x, y, heading), env.lidar.angles
        scan = Scan(angles[-1], angles[0] - angles[1], ranges[::-1].copy())
        left, right, *_ = pilot.decide(scan, (x, y, heading), env.motion[3:], time=0.2 * step)
        action = np.clip(np.array((left, right)) / 0.7, -1.0, 1.0)
        _, _, ended, _, info = env.step(action.astype(np.float32))
        if ended:
            break
    assert info["success"] and not info["collision"]
    env.close()


def test_a_planner_of_paths_needs_the_plan_and_drives_wherever_its_frame_lies() -> None:
    scan = Scan(-math.pi, math.pi / 180.0, np.full(360, 3.0), 0.05, 10.0)
    orders = []
    for pose in ((0.0, 0.0, 0.0), (2.0, -1.0, math.pi / 2)):
        x, y, turn = pose
        pilot = make_pilot("astar", robot="kobuki")
        # From the middle of the world three meters along its x axis.
        goal = (x + 3.0 * math.cos(turn), y + 3.0 * math.sin(turn))
        pilot.begin(goal, plan=World(name="hall", size=(12.0, 8.0)), plan_pose=pose)
        orders.append(pilot.decide(scan, (x, y, turn - 0.3), (0.0, 0.0)))
    assert orders[0].linear > 0.1 and orders[0].angular > 0.1
    assert orders[1] == pytest.approx(orders[0], abs=1e-6)
    pilot = make_pilot("astar", robot="kobuki")
    pilot.begin((3.0, 0.0))
    with pytest.raises(ValueError, match="world must be known to a planner of paths"):
        pilot.decide(scan, (0.0, 0.0, 0.0), (0.0, 0.0))


def test_before_the_first_reset_there_is_no_errand() -> None:
    env = VectorNavigationEnv(1, world="A", physics="kinematic")
    with pytest.raises(ResetNeeded, match=r"there is no errand: call reset\(\) first"):
        env.errand(0)
    env.close()


def test_the_senses_of_some_robots_are_their_rows() -> None:
    env = VectorNavigationEnv(4, world="C", plan="known", **TASK)
    env.reset(seed=3)
    every = env.senses(np.arange(4))
    some = every.of(np.array([True, False, False, True]))
    apart = env.senses(np.array([0, 3]))
    for name in ("robots", "observations", "states", "motions", "poses", "goals"):
        np.testing.assert_array_equal(getattr(some, name), getattr(apart, name), err_msg=name)
    assert some.find_still is not None and apart.find_still is not None
    assert some.find_still().shape == (2, env.config.make_lidar().sectors)
    np.testing.assert_array_equal(some.find_still(), apart.find_still())
    assert some.find_still().any()
    env.close()
