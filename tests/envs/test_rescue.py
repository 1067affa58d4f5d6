"""A planner leads a policy away that stands at the same place again."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mpfa_envs import Task, TaskConfig, VectorNavigationEnv, run_tasks
from mpfa_envs.control.rescue import Rescued
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.planners.piloted import card_of
from mpfa_envs.tasks.sampling import WorldTask
from mpfa_envs.worlds.world import World

TASK: dict[str, Any] = {"robot": "kobuki", "physics": "kinematic", "memory": "map"}
HALL = World(name="hall", size=(14.0, 6.0))
TASKS = [WorldTask(HALL, Task((-5.0, y, 0.0), (5.0, y))) for y in (0.0, 1.0)]


def stand(observations: np.ndarray) -> np.ndarray:
    return np.zeros((len(observations), 2), np.float32)


def test_a_policy_that_stands_twice_at_a_place_is_led_some_meters_and_no_farther() -> None:
    lazy = Rescued(stand)
    places: dict[int, np.ndarray] = {}

    def keep(env: VectorNavigationEnv, robot: int, number: int) -> None:
        places[number] = np.array(env.trail(robot))[:, 0]

    limit = {"max_steps": 420}
    results = run_tasks(lazy, TASKS, on_end=keep, **TASK | limit)
    assert not any(each.success or each.collision for each in results)
    for x in places.values():
        assert np.ptp(x[:200]) == 0.0  # It stands for ten seconds, twice.
        assert x[-1] - x[0] == pytest.approx(4.0, abs=0.5)
    assert lazy.count == 2


def test_a_policy_that_comes_back_to_stand_again_is_led_twice_as_far() -> None:
    lazy, led = Rescued(stand), 0
    env = VectorNavigationEnv(1, world=HALL, **TASK)
    env.reset(seed=0, options={"tasks": [TASKS[0].task]})
    lazy.begin(0, env.errand(0))
    lengths: list[float] = []
    for _ in range(900):
        senses = env.senses(np.array([0]))
        # As of a robot that stands at one place whenever nobody leads it.
        back = senses.motions.copy()
        back[:, 0] = -5.0 + (0.14 * (led % 8) if lazy.leads(0) else 0.0)
        lazy.drive(senses._replace(motions=back))
        if lazy.leads(0):
            led += 1
        elif led:
            lengths.append(led)
            led = 0
    assert lazy.count >= 3
    assert lengths[1] == pytest.approx(2 * lengths[0], rel=0.2)


def test_a_policy_that_drives_is_left_alone() -> None:
    def ahead(observations: np.ndarray) -> np.ndarray:
        return np.ones((len(observations), 2), np.float32)

    led = Rescued(ahead)
    alone = run_tasks(ahead, TASKS, envs_at_once=2, **TASK)
    assert [each.time_s for each in run_tasks(led, TASKS, envs_at_once=2, **TASK)] == [
        each.time_s for each in alone
    ]
    assert led.count == 0


def drive(pilot: Pilot, seconds: float) -> list[bool]:
    """Drive in an endless hall as ordered; whether the planner led in each decision."""
    x, led = 0.0, []
    pilot.begin((12.0, 0.0))
    scan = Scan(-math.pi, math.pi / 180.0, np.full(360, 9.0), 0.05, 10.0)
    heading, speeds = 0.0, (0.0, 0.0)
    y = 0.0
    for _ in range(round(seconds / 0.2)):
        command = pilot.decide(scan, (x, y, heading), speeds)
        led.append(pilot.is_led)
        speeds = command.linear, command.angular
        heading += 0.2 * command.angular
        x += 0.2 * command.linear * math.cos(heading)
        y += 0.2 * command.linear * math.sin(heading)
    return led


def test_a_pilot_drives_back_at_the_first_stand_and_is_led_from_the_second() -> None:
    card = card_of(TaskConfig(**TASK))
    pilot = Pilot(card, stand, clearance=0.03)
    led = drive(pilot, 35.0)
    assert pilot.recoveries == 1 and any(led) and not any(led[:100])
    # No filter keeps it off what it sees, or nobody wants it.
    assert not any(drive(Pilot(card, stand), 40.0))
    assert not any(drive(Pilot(card, stand, clearance=0.03, rescue=False), 40.0))
    without_map = card_of(TaskConfig(robot="kobuki"))
    assert not any(drive(Pilot(without_map, stand, clearance=0.03), 40.0))
    with pytest.raises(ValueError, match="rescue must be"):
        Pilot(card, stand, rescue="always")  # type: ignore[arg-type]
