"""Noise as on a robot: the effect of each kind."""

import math

import numpy as np
import pytest

from mpfa_envs import (
    OBSERVATION,
    WORLDS,
    Lidar,
    NavigationEnv,
    RobotNoise,
    Task,
    VectorNavigationEnv,
)
from mpfa_envs.robots.noise import NoisyMotion

ALL = RobotNoise(range_noise=0.03, dropout=0.05, slip=0.1, drift=0.05)
AHEAD = Task((-4.0, 0.0, 0.0), (4.0, 0.0))
KINEMATIC = {"physics": "kinematic"}


def drive(noise, actions, *, world="A", task=AHEAD, seed=0, **arguments):
    """Observations, poses and infos of one robot; the first ones are those of the reset."""
    env = NavigationEnv(world=world, noise=noise, **{**KINEMATIC, **arguments})
    seen, info = env.reset(seed=seed, options=task and task._asdict())
    rows = [(seen, info)]
    for action in actions:
        seen, _, terminated, truncated, info = env.step(action)
        rows.append((seen, info))
        if terminated or truncated:
            break
    env.close()
    return np.array([seen for seen, _ in rows]), [info for _, info in rows]


def places(infos):
    return np.array([[info[name] for name in ("x", "y", "heading")] for info in infos])


def test_late_actions_are_those_that_were_told_before():
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (30, 2))
    _, prompt = drive(None, actions, action_repeat=1)
    _, late = drive(None, actions, action_repeat=1, latency=0.3)
    np.testing.assert_allclose(places(late)[:4], [AHEAD.start] * 4)  # It stands.
    np.testing.assert_allclose(places(late)[3:], places(prompt)[:-3], atol=1e-12)


@pytest.mark.parametrize(("latency", "lost"), [(0.3, 0.15), (0.22, 0.1), (0.02, 0.0)])
def test_latency_counts_seconds_and_not_decisions(latency, lost):
    _, late = drive(None, np.ones((4, 2)), action_repeat=2, latency=latency)
    told = np.maximum(0.1 * np.arange(5.0) - lost, 0.0)
    np.testing.assert_allclose(places(late)[:, 0] + 4.0, told, atol=1e-12)


def test_a_range_of_latencies_is_sampled_for_each_episode():
    env = VectorNavigationEnv(300, world="A", latency=(0.1, 0.3), **KINEMATIC)
    env.reset(seed=0)
    env.step(np.ones((300, 2)))
    driven = np.linalg.norm(env.poses[:, :2] - [task.start[:2] for task in env.tasks], axis=1)
    # A quarter is 0.1 s late.
    assert set(np.unique(driven.round(9))) == {0.0, 0.05}
    assert (driven > 0.0).mean() == pytest.approx(0.25, abs=0.1)


@pytest.mark.parametrize("latency", [-0.1, (0.3, 0.1), 3.0, "soon", (0.1, 0.2, 0.3)])
def test_a_latency_out_of_range_is_rejected(latency):
    with pytest.raises(ValueError, match=r"latency must be seconds in \[0, 2\], or the least"):
        VectorNavigationEnv(1, latency=latency, **KINEMATIC)


def test_latency_in_the_noise_of_earlier_versions_is_rejected_unless_it_is_none():
    assert VectorNavigationEnv(1, noise={"slip": 0.1, "latency": 0}, **KINEMATIC)
    with pytest.raises(ValueError, match=r"noise must not hold 'latency', got .*beside noise"):
        VectorNavigationEnv(1, noise={"latency": 1}, **KINEMATIC)


@pytest.mark.parametrize("latency", [0.1, 0.25])
def test_what_is_observed_is_where_the_robot_is_when_its_order_acts(latency):
    arguments = {"world": "B", "robot": "kobuki", "memory": "map", "latency": latency}
    actions = np.random.default_rng(5).uniform(-0.2, 1.0, (12, 2)).repeat(2, axis=0)
    env = NavigationEnv(action_repeat=1, time_step=0.05, **arguments, **KINEMATIC)
    seen, _ = env.reset(seed=3)
    rows, motions = [seen], [env.motion]
    for action in actions:
        seen, *_ = env.step(action)
        rows.append(seen)
        motions.append(env.motion)
    steps = round(latency / 0.05)
    for row, motion in zip(rows[:-steps], motions[steps:], strict=True):
        x, y, heading, forward, _ = motion
        goal = env.task.goal
        bearing = math.atan2(goal[1] - y, goal[0] - x) - heading
        np.testing.assert_allclose(
            row[env.config.observation_slices["goal_direction"]],
            [math.cos(bearing), math.sin(bearing)],
            atol=1e-4,
        )
        distance = row[env.config.observation_slices["goal_distance"]][0] * 10.0
        assert distance == pytest.approx(math.dist((x, y), goal), abs=1e-4)
        speeds = row[env.config.observation_slices["linear_speed"]][0] * 0.7
        assert speeds == pytest.approx(forward, abs=1e-6)


def test_a_wheel_slips_by_its_share_unseen_by_odometry():
    seen, infos = drive(RobotNoise(slip=0.2), np.ones((60, 2)), action_repeat=1)
    told, driven = 0.05 * 60, infos[-1]["path_length"]
    assert driven == pytest.approx(0.8 * told, rel=0.03)
    # By odometry the robot has gone straight ahead, as it was told.
    goal = seen[-1][OBSERVATION["goal_distance"]] * 10.0
    assert goal == pytest.approx(8.0 - told, abs=1e-5)
    np.testing.assert_allclose(seen[-1][OBSERVATION["goal_direction"]], [1.0, 0.0], atol=1e-6)
    assert abs(infos[-1]["heading"]) > 1e-3


def test_drift_scales_paths_and_turns_alike_throughout_an_episode():
    motion = NoisyMotion(RobotNoise(drift=0.05), 4000, wheel_base=0.23, time_step=0.1)
    rng = np.random.default_rng(0)
    for robot in range(4000):
        motion.begin(robot, (0.0, 0.0, 0.0), rng)
    motions, everyone = np.zeros((4000, 5)), np.ones(4000, dtype=bool)
    motions[:, 0] = 0.05
    motion.measure(motions, everyone)
    paths = motion.odometry[:, 0] / 0.05
    assert paths.mean() == pytest.approx(1.0, abs=0.003)
    assert paths.std() == pytest.approx(0.05, rel=0.04)
    np.testing.assert_allclose(motion.odometry[:, 3], paths * 0.5)
    motions[:, 2] = 0.2  # A turn on the spot.
    motion.measure(motions, everyone)
    turns = motion.odometry[:, 2] / 0.2
    assert turns.std() == pytest.approx(0.05, rel=0.04)
    assert abs(np.corrcoef(paths, turns)[0, 1]) < 0.05
    motions[:, 0] = 0.05 + 0.05 * math.cos(0.2)
    motions[:, 1] = 0.05 * math.sin(0.2)
    motion.measure(motions, everyone)
    np.testing.assert_allclose(np.hypot(*(motion.odometry[:, :2]).T), 0.1 * paths, rtol=0.02)


def test_the_task_is_judged_by_where_the_robot_is():
    noise = RobotNoise(drift=0.3)
    seen, infos = drive(noise, np.ones((80, 2)), seed=2)
    assert infos[-1]["success"]
    assert infos[-1]["distance"] == pytest.approx(math.dist(places(infos)[-1][:2], AHEAD.goal))
    held = seen[-1][OBSERVATION["goal_distance"]][0] * 10.0
    assert abs(held - infos[-1]["distance"]) > 0.1


def test_rays_drop_out_as_often_as_is_said():
    lidar = Lidar(WORLDS["A"], dropout=0.1, max_range=20.0)
    rng = np.random.default_rng(0)
    scans = np.array([lidar.measure(0.0, 0.0, 0.0, rng=rng) for _ in range(400)])
    lost = scans == 20.0
    assert lost.mean() == pytest.approx(0.1, abs=0.006)
    clear = Lidar(WORLDS["A"], max_range=20.0).measure(0.0, 0.0, 0.0)
    np.testing.assert_array_equal(scans[~lost], np.broadcast_to(clear, scans.shape)[~lost])
    with pytest.raises(ValueError, match="rng must be a Generator"):
        lidar.measure(0.0, 0.0, 0.0)


def test_twice_the_noise_is_twice_each():
    assert ALL.times(2) == RobotNoise(range_noise=0.06, dropout=0.1, slip=0.2, drift=0.1)
    assert ALL.times(0) == RobotNoise()
