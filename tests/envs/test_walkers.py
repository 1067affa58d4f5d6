"""Walkers: their paths against plain geometry, and what robots see of them."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mpfa_envs import (
    Box,
    Cylinder,
    Lidar,
    NavigationEnv,
    VectorNavigationEnv,
    Walker,
    World,
    evaluate,
    summarize,
)
from mpfa_envs.scene.colors import WALKER
from mpfa_envs.walkers.batch import WalkerBatch, start_walkers
from mpfa_envs.walkers.loops import time_to_collision
from mpfa_envs.worlds.batch import WorldBatch
from tests.envs.busy import BUSY, POLITE, ROUND


def batch_of(world: World, seed: int = 0, time_step: float = 0.1) -> WalkerBatch:
    batch = WalkerBatch(WorldBatch([world]), radius=0.18, time_step=time_step)
    batch.begin(0, start_walkers(world, (4.0, 4.0), np.random.default_rng(seed)))
    return batch


def walk(batch: WalkerBatch, steps: int) -> np.ndarray:
    """States of the walkers after each step, ``[steps, K, 5]``."""
    states = []
    for _ in range(steps):
        batch.move(np.ones(1, dtype=np.bool_), np.zeros((1, 5)))
        states.append(batch.of(0))
    return np.array(states)


def test_a_walker_between_walls_bounces_as_a_folded_line_does() -> None:
    world = World(name="empty", size=(6.0, 4.0), walkers=(Walker(radius=0.3, speed=0.4),))
    batch = batch_of(world, time_step=0.02)
    x, y, speed_x, speed_y, _ = batch.of(0)[0].tolist()
    seen = walk(batch, 3000)[:, 0]
    times = 0.02 * np.arange(1, 3001)
    for column, place, speed, half in ((0, x, speed_x, 2.7), (1, y, speed_y, 1.7)):
        # Unfolded, the walker goes on behind the wall; each bounce may be a stride early.
        far = (place + speed * times + half) % (4 * half)
        folded = np.where(far > 2 * half, 4 * half - far, far) - half
        assert np.abs(seen[:, column] - folded).max() < 0.1
        assert (np.abs(np.diff(np.sign(seen[:, column + 2]))) > 0).sum() >= 2
    np.testing.assert_allclose(np.hypot(seen[:, 2], seen[:, 3]), 0.4)


@pytest.mark.parametrize("seed", range(4))
def test_straight_walkers_run_into_nothing_and_never_stop_for_long(seed: int) -> None:
    world = replace(BUSY, walkers=BUSY.walkers[:4] * 2)
    seen = walk(batch_of(world, seed), 1000)
    gaps = np.array([world.clearances(step[:, :2]) - step[:, 4] for step in seen])
    assert gaps.min() > -1e-9
    for one in range(8):
        for other in range(one):
            apart = np.hypot(*(seen[:, one, :2] - seen[:, other, :2]).T) - 0.4
            assert apart.min() > -0.06  # Both may take a stride at once.
    path = np.hypot(*np.diff(seen[:, :, :2], axis=0).transpose(2, 0, 1)).sum(axis=0)
    speeds = np.array([walker.speed for walker in world.walkers])
    np.testing.assert_array_less(0.9 * 100 * speeds, path)
    assert (np.hypot(seen[..., 2], seen[..., 3]) - speeds).max() < 1e-9


def test_a_walker_goes_its_round_at_its_speed() -> None:
    batch = batch_of(BUSY)
    corners = np.array([*ROUND, ROUND[0]])
    ends = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))

    def along(place: np.ndarray) -> float:
        """How far along the round a place is [m]."""
        for first, last, before in zip(corners, corners[1:], ends, strict=False):
            leg = np.hypot(*(last - first))
            share = (place - first) @ (last - first) / leg**2
            if 0.0 <= share <= 1.0 and np.allclose(first + share * (last - first), place):
                return before + share * leg
        raise AssertionError(place)

    start = along(batch.of(0)[5, :2])
    for step, states in enumerate(walk(batch, 700), 1):
        expected = (start + 0.05 * step) % ends[-1]
        off = (along(states[5, :2]) - expected + ends[-1] / 2) % ends[-1] - ends[-1] / 2
        assert abs(off) < 1e-9
        assert np.hypot(*states[5, 2:4]) == pytest.approx(0.5)


def test_walkers_start_elsewhere_each_episode_away_from_the_robot() -> None:
    batch = WalkerBatch(WorldBatch([BUSY]), radius=0.18, time_step=0.1)
    rng, places = np.random.default_rng(0), []
    for _ in range(50):
        batch.begin(0, start_walkers(BUSY, (0.0, -1.0), rng))
        states = batch.of(0)
        assert (np.hypot(states[:, 0], states[:, 1] + 1.0) - states[:, 4]).min() >= 1.0
        assert (BUSY.clearances(states[:, :2]) - states[:, 4]).min() > -1e-9
        gaps = np.hypot(*(states[:, None, :2] - states[None, :, :2]).transpose(2, 0, 1))
        assert (gaps + np.eye(6) >= states[:, 4] + states[:, None, 4]).all()
        places.append(states[:, :2])
    assert np.std(places, axis=0).min() > 0.5


def test_a_walker_that_fits_nowhere_is_told_of() -> None:
    world = World(name="full", size=(2.0, 2.0), boxes=(Box(-0.9, -0.9, 0.9, 0.9),))
    with pytest.raises(ValueError, match=r"world 'full' has no place for Walker\(radius=0.25"):
        batch_of(replace(world, walkers=(Walker(),)))


def test_walkers_that_avoid_each_other_do_not_collide() -> None:
    pytest.importorskip("pyrvo", reason="an extra")
    seen = walk(batch_of(POLITE), 1500)
    assert min(POLITE.clearances(step[:4, :2]).min() for step in seen) > 0.18
    for one in range(4):
        for other in range(one):
            assert np.hypot(*(seen[:, one, :2] - seen[:, other, :2]).T).min() > 0.38
    path = np.hypot(*np.diff(seen[:, :4, :2], axis=0).transpose(2, 0, 1)).sum(axis=0)
    assert path.min() > 0.7 * 150 * 0.4
    assert np.hypot(seen[:, :4, 2], seen[:, :4, 3]).max() < 0.401


def test_a_walker_that_avoids_others_goes_around_the_robot() -> None:
    pytest.importorskip("pyrvo", reason="an extra")
    there_and_back = Walker(behavior="orca", waypoints=((-3.0, 0.01), (3.0, 0.01)))
    lane = World(name="lane", walkers=(there_and_back,))
    batch = WalkerBatch(WorldBatch([lane]), radius=0.18, time_step=0.1)
    batch.begin(0, start_walkers(lane, (0.0, 0.0), np.random.default_rng(0)))
    gaps, places = [], []
    for _ in range(600):
        batch.move(np.ones(1, dtype=np.bool_), np.zeros((1, 5)))
        x, y, *_ = batch.of(0)[0].tolist()
        gaps.append(math.hypot(x, y) - 0.43)
        places.append(x)
    assert min(gaps) > -0.01
    assert min(places) < -2.0 and max(places) > 2.0


def test_without_the_library_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrvo", None)
    with pytest.raises(ImportError, match="behavior='orca' needs pyrvo: install the extra 'orca'"):
        batch_of(POLITE)


def frozen(world: World, walkers: np.ndarray) -> World:
    """A world in which the walkers stand as cylinders."""
    cylinders = [Cylinder(x, y, radius) for x, y, _, _, radius in walkers.tolist()]
    return replace(world, cylinders=(*world.cylinders, *cylinders), walkers=())


def test_walkers_are_seen_and_run_into_as_cylinders_would_be() -> None:
    env = VectorNavigationEnv(1, world=BUSY, physics="kinematic", contact=True)
    rng, collisions = np.random.default_rng(0), 0
    env.reset(seed=3)
    for _ in range(300):
        *_, infos = env.step(rng.uniform(0.2, 1.0, (1, 2)).astype(np.float32))
        world = frozen(BUSY, env.walkers(0))
        pose = env.poses[0].tolist()
        if infos["sim_time"][0] > 0:  # The walkers of a new episode have not walked yet.
            collision = world.clearance(*pose[:2]) <= 0.18 and not infos["success"][0]
            assert infos["collision"][0] == collision
            collisions += bool(collision and BUSY.clearance(*pose[:2]) > 0.18)
        expected = Lidar(world).cast(*pose)
        np.testing.assert_allclose(env._batch.ranges[0], expected, atol=1e-9)
    assert collisions > 2


def test_a_robot_that_waits_keeps_its_scans_and_its_walkers() -> None:
    env = VectorNavigationEnv(2, world=BUSY, physics="kinematic", history=3)
    env.reset(seed=0)
    for step in range(10):
        env.step(np.full((2, 2), 0.1 * step))
    before, seen = env.walkers(1), env.observations[1].copy()
    env.step(np.zeros((2, 2)), only=np.array([True, False]))
    np.testing.assert_array_equal(env.walkers(1), before)
    np.testing.assert_array_equal(env.observations[1], seen)


def plain_time(x: float, y: float, speed_x: float, speed_y: float, reach: float) -> float:
    """The first of many instants at which the discs overlap."""
    times = np.linspace(0.0, 10.0, 10_001)
    near = np.hypot(x + speed_x * times, y + speed_y * times) <= reach
    return float(times[np.argmax(near)]) if near.any() else 10.0


def test_the_time_to_collision_is_the_first_overlap() -> None:
    rng, found = np.random.default_rng(0), []
    for _ in range(300):
        x, y, speed_x, speed_y = (rng.uniform(-1.0, 1.0, 4) * (3.0, 3.0, 1.0, 1.0)).tolist()
        expected = plain_time(x, y, speed_x, speed_y, 0.43)
        if expected in (0.0, 10.0) or abs(expected - 10.0) > 0.01:
            found.append(expected)
            ours = time_to_collision(x, y, speed_x, speed_y, 0.43)
            assert ours == pytest.approx(expected, abs=1.1e-3)
    assert {0.0, 10.0} < set(found)
    assert time_to_collision(2.0, 0.0, 0.0, 0.0, 0.5) == 10.0


def test_encounters_are_counted_over_an_episode() -> None:
    env = NavigationEnv(world=BUSY, physics="kinematic", action_repeat=1, lidar={"sectors": 4})
    for seed in range(3):
        _, info = env.reset(seed=seed)
        assert (info["walker_distance"], info["intrusion_time"]) == (10.0, 0.0)
        nearest, near, least, ended = 10.0, 0, 10.0, False
        while not ended:
            _, _, terminated, truncated, info = env.step(np.array([0.8, 0.75], np.float32))
            ended = terminated or truncated
            x, y, heading = (info[name] for name in ("x", "y", "heading"))
            speed = env.motion[3]
            gaps = [math.hypot(w[0] - x, w[1] - y) - w[4] - 0.18 for w in env.walkers]
            nearest, near = min(nearest, *gaps), near + (min(gaps) < 0.5)
            least = min(
                least,
                *(
                    plain_time(
                        w[0] - x, w[1] - y,
                        w[2] - speed * math.cos(heading), w[3] - speed * math.sin(heading),
                        w[4] + 0.18,
                    )
                    for w in env.walkers
                ),
            )  # fmt: skip
            assert info["walker_distance"] == pytest.approx(nearest, abs=1e-9)
            assert info["intrusion_time"] == pytest.approx(0.1 * near)
            assert info["time_to_collision"] == pytest.approx(least, abs=1.1e-3)


def test_results_tell_of_walkers_if_there_are_any() -> None:
    given: dict[str, Any] = {"physics": "kinematic", "max_steps": 60}
    results = evaluate(lambda seen: np.ones(2), ["A", BUSY], episodes=6, **given)
    assert all(found.walker_distance is None for found in results[:6])
    met = results[6:]
    assert all(found.walker_distance >= found.min_clearance for found in met)
    summary = summarize(results)
    times = [found.time_to_collision for found in met]
    assert summary["time_to_collision"].value == pytest.approx(np.mean(times))
    assert "intrusion_time" in summary and "intrusion_time" not in summarize(results[:6])
    # The number of a task, here from 0 on, is the seed of its walkers.
    alone, together = (
        evaluate(policy, BUSY, episodes=6, envs_at_once=count, **given)
        for policy, count in ((lambda _: np.ones(2), 1), (lambda seen: np.ones((len(seen), 2)), 3))
    )
    assert alone == together


def test_a_picture_shows_the_walkers_where_they_are() -> None:
    given: dict[str, Any] = {"physics": "kinematic", "render_mode": "rgb_array"}
    env = NavigationEnv(world=BUSY, **given)
    env.reset(seed=0)
    picture = env.render()
    assert picture is not None
    for x, y, speed_x, speed_y, radius in env.walkers.tolist():
        # Beside the line that shows where it goes.
        aside = 0.5 * radius / math.hypot(speed_x, speed_y)
        at = x - aside * speed_y, y + aside * speed_x
        column, row = (
            (5.2 + sign * each) * 480 / 10.4 for sign, each in zip((1, -1), at, strict=True)
        )
        assert picture[int(row), int(column)].tolist() == list(WALKER[:3])
