"""Pictures of values, samples and episodes: whether colors are where the numbers are."""

from __future__ import annotations

import numpy as np
import pytest

from mpfa_envs import OBSERVATION, NavigationEnv, World, world_tasks
from mpfa_envs.render import (
    Panel,
    film_episode,
    grids,
    observe_room,
    render_samples,
    render_traces,
    render_values,
    viridis,
)
from mpfa_envs.render.grids import arc_of
from mpfa_envs.robots.model import ROBOTS
from mpfa_envs.scene.colors import LINES
from tests.envs.test_render import pixel

GOAL = (3.0, 3.0)


def test_the_observations_of_a_room_are_first_observations_of_episodes() -> None:
    how = {"memory": "map", "history": 1, "closeness_distance": 0.4}
    poses, observations = observe_room("B", goal=GOAL, heading=0.7, spacing=1.1, **how)
    env = NavigationEnv(world="B", physics="kinematic", **how)
    assert len(poses) > 40 and (poses[:, 2] == 0.7).all()
    for number in (0, 17, len(poses) - 1):
        options = {"start": tuple(poses[number]), "goal": GOAL}
        np.testing.assert_array_equal(env.reset(options=options)[0], observations[number])
    to_goal = np.hypot(*(poses[:, :2] - GOAL).T)
    assert to_goal.min() > 0.5
    assert env.world.clearances(poses[:, :2]).min() > env.config.robot.radius


def test_a_cell_has_the_color_of_its_value() -> None:
    def nearness(observations: np.ndarray) -> np.ndarray:
        return -observations[:, OBSERVATION["goal_distance"]].ravel()

    picture = render_values("A", goal=GOAL, values=nearness, spacing=0.5)
    lightness = [sum(pixel(picture, x, x)) for x in (-4.3, -2.3, 0.2, 1.7)]
    assert lightness == sorted(lightness)
    assert pixel(picture, -4.3, -4.3) == tuple(viridis(0.0).tolist())
    plain = render_values("A", goal=GOAL, spacing=0.5)
    assert pixel(plain, -4.3, -4.3) == (250, 249, 246)


def test_an_arrow_shows_where_the_action_leads() -> None:
    def turned(left: float, right: float) -> np.ndarray:
        return render_values(
            World(name="empty", size=(4.0, 4.0)),
            goal=(1.6, 1.6),
            actions=lambda seen: np.tile([left, right], (len(seen), 1)),
            arrow_spacing=3.9,
            size=440,
        )

    ahead, left, right = turned(1.0, 1.0), turned(-1.0, 1.0), turned(1.0, -1.0)
    above, below = slice(150, 218), slice(222, 290)
    white = [(each[:440, 215:300] == 255).all(-1) for each in (ahead, left, right)]
    assert white[1][above].sum() > 3 * white[1][below].sum()
    assert white[2][below].sum() > 3 * white[2][above].sum()
    assert white[0][215:225].sum() > 40


def test_an_arc_is_as_long_as_the_robot_drives() -> None:
    robot = ROBOTS["turtlebot2"]
    straight = arc_of(robot, (1.0, 2.0, np.pi / 2), np.array([1.0, 1.0]), seconds=2.0)
    assert straight[-1] == pytest.approx((1.0, 3.0))
    arc = np.array(arc_of(robot, (0.0, 0.0, 0.0), np.array([-1.0, 1.0]), seconds=1.0, points=99))
    assert np.hypot(*np.diff(arc, axis=0).T).sum() == pytest.approx(0.275, rel=1e-3)
    assert arc[-1, 1] > 0.1


def halves() -> np.ndarray:
    """A thousand positions on the left of a room, a hundred on its right."""
    rng = np.random.default_rng(0)
    x = np.concatenate((rng.uniform(-4, -2, 1000), rng.uniform(2, 4, 100)))
    return np.stack((x, rng.uniform(-1, 1, 1100)), axis=1)


def test_samples_are_bright_where_transitions_priorities_and_samples_are_many() -> None:
    places = halves()
    right = places[:, 0] > 0
    pictures = render_samples(
        "A", places, np.where(right, 9.0, 1.0), np.where(right, 3, 1), spacing=1.0, size=480
    )
    panels = [pictures[:, 488 * n : 488 * n + 480] for n in range(3)]
    sums = [[sum(pixel(each, x, 0.3)) for x in (-3.3, 3.3)] for each in panels]
    assert sums[0][0] > sums[0][1]
    assert sums[1][1] > sums[1][0]
    assert sums[2][1] > sums[2][0]
    assert pixel(panels[0], 0.3, 3.3) == (250, 249, 246)


def test_rates_are_in_units_of_uniform_sampling(monkeypatch: pytest.MonkeyPatch) -> None:
    ends, real = {}, grids.Scale

    def scale(name: str, low: float, high: float) -> grids.Scale:
        ends[name] = low, high
        return real(name, low, high)

    monkeypatch.setattr(grids, "Scale", scale)
    places = halves()
    counts = np.where(places[:, 0] > 0, 3, 1)
    render_samples("A", places, counts, counts, spacing=1.0)
    mean = sum(counts.tolist()) / len(counts)
    assert ends["sampled"] == pytest.approx((1 / mean, 3 / mean))
    assert ends["priority"] == (1.0, 3.0)


def test_samples_may_be_numbers_of_transitions() -> None:
    places = halves()
    counts = np.arange(1100) % 4
    numbers = np.repeat(np.arange(1100), counts)
    one, other = (render_samples("A", places, np.ones(1100), each) for each in (counts, numbers))
    np.testing.assert_array_equal(one, other)


def test_a_trace_goes_up_to_the_present_step() -> None:
    def share(step: int, last: int | None) -> float:
        panel = Panel("Q", {"": np.linspace(0.0, 1.0, 21).tolist()}, last)
        picture = render_traces([panel], step, step_time=0.2, width=240, height=200)
        there = (abs(picture[30:].astype(int) - LINES[0]).sum(-1) < 60).any(0)
        return float(there[44:226].mean())

    assert share(5, None) == pytest.approx(0.26, abs=0.05)
    assert share(20, None) == pytest.approx(1.0, abs=0.03)
    assert share(20, 6) == pytest.approx(1.0, abs=0.03)


def ahead(observations: np.ndarray) -> np.ndarray:
    return np.ones((len(observations), 2), np.float32)


def test_a_film_shows_each_decision_and_the_end() -> None:
    task = world_tasks("A", episodes=1)[0]
    seen: list[int] = []

    def values(observations: np.ndarray) -> np.ndarray:
        seen.append(len(observations))
        return observations[:, 0]

    film = film_episode(ahead, task, values=values, physics="kinematic", max_steps=6)
    assert len(film.frames) == 4 and seen == [4]
    assert film.frame_time == pytest.approx(0.2)
    assert {frame.shape for frame in film.frames} == {(480, 720, 3)}
    bare = film_episode(ahead, task, traces=False, physics="kinematic", max_steps=6)
    np.testing.assert_array_equal(bare.frames[2], film.frames[2][:, :480])


def test_a_long_film_has_fewer_pictures_and_its_end() -> None:
    task = world_tasks("A", episodes=1)[0]
    how = {"traces": False, "physics": "kinematic", "max_steps": 30, "action_repeat": 1}
    every = film_episode(lambda seen: -ahead(seen), task, most=40, **how)
    fewer = film_episode(lambda seen: -ahead(seen), task, most=10, **how)
    assert len(every.frames) == 31 and every.frame_time == pytest.approx(0.1)
    assert len(fewer.frames) == 9 and fewer.frame_time == pytest.approx(0.4)
    for number, frame in enumerate(fewer.frames[:-1]):
        np.testing.assert_array_equal(frame, every.frames[4 * number])
    np.testing.assert_array_equal(fewer.frames[-1], every.frames[-1])
