"""Late orders in the default run: what a robot allows for, and what its filter makes of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mpfa_envs import ROBOTS, TaskConfig
from mpfa_envs.robots.drives import LateOrders, Orders
from mpfa_envs.robots.motion_loops import WheelLimits, changed
from mpfa_envs.safety.loops import Body, room_after
from tests.envs.test_safety import ahead_is, observed, task

KOBUKI = ROBOTS["kobuki"]


def test_a_robot_allows_for_orders_that_act_early_and_late_by_weak_wheels() -> None:
    orders = Orders(KOBUKI)
    orders.give(-1.0, 0.4, 0.0)
    moving = np.array((0.0, 0.0, 0.0, 0.4, 0.0))
    told, late, early = orders.states(moving, 0.0, 0.0, 0.2, certain=False)
    assert [state[0] for state in (told, late, early)] == pytest.approx([0.08, 0.1, 0.06])
    assert orders.states(moving, 0.0, 0.0, 0.2, certain=True).tolist() == [told.tolist()]
    # An order of less latency than the error of 0.05 s may act at once.
    assert orders.states(moving, 0.0, 0.0, 0.02, certain=False)[2, 0] == 0.0
    # From a stand, the wheels that are slower by a fifth are driven for longer.
    slow = orders.states(np.zeros(5), 0.0, 0.0, 0.2, certain=False)[:, 3]
    assert slow == pytest.approx([0.16, 0.25 * 0.8 * 0.8, 0.12])


def test_a_turn_may_change_at_once_though_the_file_says_how_fast() -> None:
    robot = replace(KOBUKI, name="own", turn_acceleration=1.0)
    orders = Orders(robot)
    orders.give(-1.0, 0.0, 1.0)
    told, late, early = orders.states(np.zeros(5), 0.0, 0.0, 0.2, certain=False)
    assert told[4] == pytest.approx(0.2) and late[4] == pytest.approx(0.25 * 0.8)
    # The wheels' own limit of 0.8 m/s2 holds: 0.12 m/s each after 0.15 s.
    assert early[4] == pytest.approx(min(1.0, 2 * 0.12 / robot.wheel_base))


def test_each_episode_begins_without_the_orders_of_the_one_before() -> None:
    late = LateOrders(KOBUKI, 2, latency=(0.2, 0.2), time_step=0.1)
    rng, both = np.random.default_rng(0), np.ones(2, dtype=np.bool_)
    for robot in range(2):
        late.begin(robot, rng)
    for speed in (0.1, 0.2, 0.3):
        wheels = late.arriving(np.full((2, 2), speed), both)
    assert wheels.tolist() == [[0.1, 0.1]] * 2
    late.begin(1, rng)
    told = [late.arriving(np.full((2, 2), 0.5), both).tolist() for _ in range(3)]
    assert told[0] == [[0.2, 0.2], [0.0, 0.0]]
    assert told[1] == [[0.3, 0.3], [0.0, 0.0]]
    assert told[2] == [[0.5, 0.5], [0.5, 0.5]]


def test_orders_under_way_are_driven_the_oldest_first() -> None:
    late = LateOrders(KOBUKI, 1, latency=(0.2, 0.2), time_step=0.1)
    late.begin(0, np.random.default_rng(0))
    for speeds in ((-0.08, 0.08), (0.08, 0.08)):
        late.arriving(np.array([speeds]), np.ones(1, dtype=np.bool_))
    [ahead] = late.ahead(np.zeros((1, 5)))
    # It turns on the spot, and then drives 4 mm while the left wheel comes to a stand.
    turn = 0.16 / KOBUKI.wheel_base * 0.1
    assert ahead[2] == pytest.approx(1.5 * turn)
    place = 0.004 * math.cos(1.25 * turn), 0.004 * math.sin(1.25 * turn)
    assert ahead[:2] == pytest.approx(place, rel=1e-3)


@pytest.mark.parametrize("first", [True, False])
def test_a_filter_of_several_states_allows_for_each(first: bool) -> None:
    config = TaskConfig(**task(), contact=True)
    keep = config.make_filter()
    states = [observed(config, 10.0), observed(config, ahead_is(config, 0.25), 0.3, 0.3)]
    action = np.ones(2, np.float32)
    free = keep.among(np.stack([states[0]] * 2), action)
    assert free.tolist() == [1.0, 1.0]
    kept = keep.among(np.stack(states if first else states[::-1]), action)
    assert kept.mean() < 0.5


def plain_room(
    command: np.ndarray, speeds: np.ndarray, points: np.ndarray, body: Body, limits: WheelLimits
) -> bool:
    """Whether a robot stays off points until it stands, step by step."""
    (left, right), x, y, heading = speeds.tolist(), 0.0, 0.0, 0.0
    for step in range(200):
        wanted = tuple(command.tolist()) if step < body.repeat else (0.0, 0.0)
        if step >= body.repeat and left == right == 0.0:
            return True
        left, right = changed((left, right), wanted, limits, body.braking, body.time_step)
        for _ in range(2):
            turn = (right - left) / body.wheel_base * body.time_step / 2
            along = 0.5 * (left + right) * body.time_step / 2
            x += along * math.cos(heading + 0.5 * turn)
            y += along * math.sin(heading + 0.5 * turn)
            heading += turn
            if (np.square(points[:, :2] - (x, y)).sum(axis=1) < points[:, 2]).any():
                return False
    raise AssertionError("it never stands")


def test_a_command_is_admissible_from_each_state_and_by_quick_turns_too() -> None:
    rng = np.random.default_rng(3)
    own = replace(KOBUKI, name="own", turn_acceleration=1.5)
    body = TaskConfig(**task(own), contact=True).make_filter().body
    body = body._replace(braking=0.8, quick=body.limits._replace(turning=math.inf))
    alone = {"state": 0, "quick": 0}
    for _ in range(400):
        command, states = rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.4, 0.4, (3, 2))
        angles, reach = rng.uniform(-math.pi, math.pi, (3, 1)), rng.uniform(0.22, 0.5, (3, 1))
        kept = np.full((3, 1), body.radius + body.clearance) ** 2
        points = np.concatenate((reach * np.cos(angles), reach * np.sin(angles), kept), axis=1)
        near, counts = points[:, None].copy(), np.ones(3, dtype=np.int64)
        free = np.array(
            [
                [
                    plain_room(command, state, point, body, limits)
                    for limits in (body.limits, body.quick)
                ]
                for state, point in zip(states, near, strict=True)
            ]
        )
        assert (room_after(command, states, near, counts, body) > -1.0) == free.all()
        alone["state"] += int(free[0].all() and not free.all())
        alone["quick"] += int(free[:, 0].all() and not free.all())
    assert min(alone.values()) >= 5, alone
