"""Drives of teams: their tasks, who touched whom, who stood for ever, and who waits."""

import math
from itertools import combinations

import numpy as np
import pytest

from mpfa_envs import Task
from mpfa_envs.driver import Filtered
from mpfa_envs.evaluation.right_of_way import RightOfWay
from mpfa_envs.evaluation.teams import run_teams, stood
from mpfa_envs.planners import make_planner
from mpfa_envs.tasks.teams import TEAM_WORLDS, TeamTask, team_tasks

KINEMATIC = {"physics": "kinematic", "robot": "kobuki"}
RADIUS = 0.18


def ahead(observations):
    return np.ones((len(observations), 2), dtype=np.float32)


def still(observations):
    return np.zeros((len(observations), 2), dtype=np.float32)


def head_on():
    pairs = Task((-2.0, 0.0, 0.0), (3.0, 0.0)), Task((2.0, 0.0, math.pi), (-3.0, 0.0))
    return TeamTask(TEAM_WORLDS["crossing"], pairs, 0)


@pytest.mark.parametrize("name", [*TEAM_WORLDS, "rooms:validation"])
def test_tasks_of_a_team_are_the_same_again_and_keep_robots_apart(name):
    tasks = team_tasks(name, 4, episodes=2, robot="kobuki")
    assert tasks == team_tasks(name, 4, episodes=2, robot="kobuki")
    for each in tasks:
        for one, other in combinations(each.tasks, 2):
            assert math.dist(one.start[:2], other.start[:2]) >= 2 * RADIUS + 0.4
            assert math.dist(one.goal, other.goal) >= 2 * RADIUS + 1.2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("lanes", 2), "world of a team must be one of"),
        (("rooms", 2), "world of a team must be one of"),
        (("crossing", 50), "team must have room in world 'crossing'"),
        (("crossing", 0), "team must be"),
    ],
)
def test_tasks_of_a_team_that_cannot_be_made_are_rejected(arguments, message):
    with pytest.raises(ValueError, match=message):
        team_tasks(*arguments)


def test_robots_that_drive_into_each_other_have_both_touched_at_their_speed():
    (result,) = run_teams(ahead, [head_on()], **KINEMATIC)
    assert (result.touched, result.hit, result.arrived) == (2, 0, 0)
    assert result.touch_speed == pytest.approx(0.7, abs=0.01)
    assert -0.15 < result.min_gap <= 0.0
    assert not result.success


def test_a_robot_that_drives_into_a_wall_has_touched_no_robot():
    world = TEAM_WORLDS["crossing"]
    pairs = Task((-2.0, 2.0, math.pi), (2.0, 2.0)), Task((-2.0, -2.0, math.pi), (2.0, -2.0))
    (result,) = run_teams(ahead, [TeamTask(world, pairs, 0)], **KINEMATIC)
    assert (result.touched, result.hit, result.touch_speed) == (0, 2, 0.0)


def test_a_team_of_which_nobody_moves_is_in_a_deadlock():
    (result,) = run_teams(still, [head_on()], **KINEMATIC)
    assert (result.deadlock, result.touched, result.arrived) == (True, 0, 0)


def test_a_team_stood_only_while_none_that_was_under_way_moved():
    standing, driving = np.zeros((200, 2)), np.stack((np.arange(200) * 0.1, np.zeros(200)), axis=1)
    assert stood([standing, standing], 0.1)
    assert not stood([standing, driving], 0.1)
    assert stood([standing, driving[:50]], 0.1)
    assert not stood([standing[:120], driving[:50]], 0.1)


@pytest.mark.slow
def test_robots_that_wait_by_their_numbers_pass_a_lane_in_which_others_meet():
    planner = make_planner("mpc", robot="kobuki")
    task = {**planner.env_arguments, "physics": "kinematic", "plan": "known"}
    keep = Filtered(planner, make_filter(task))
    tasks = team_tasks("lane", 2, episodes=2, robot="kobuki")
    assert not any(each.success for each in run_teams(keep, tasks, **task))
    waiting = run_teams(RightOfWay(keep, "kobuki", 2), tasks, **task)
    assert all(each.success and not each.touched for each in waiting)


def make_filter(task):
    from mpfa_envs import TaskConfig

    return TaskConfig(**task).make_filter()
