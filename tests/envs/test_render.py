from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from mpfa_envs import WORLDS, Box, Cylinder, Polygon, World
from mpfa_envs.render import (
    FLOOR,
    GOAL,
    OBSTACLE,
    OUTCOMES,
    RIVAL,
    TRAIL,
    WALL,
    render_methods,
    render_trajectories,
    shown_episodes,
    tiled,
    write_animation,
)
from mpfa_envs.robots.model import ROBOTS
from mpfa_envs.scene.scene import render_scene
from tests.envs.paper import paper_env


def pixel(picture: np.ndarray, x: float, y: float) -> tuple[int, ...]:
    """Color at a position [m] of a 10 x 10 m world."""
    scale = 480 / 10.4
    row, column = int((5.2 - y) * scale), int((x + 5.2) * scale)
    return tuple(picture[row, column].tolist())


def test_a_picture_shows_room_goal_robot_and_trail() -> None:
    env = paper_env(world="B", physics="kinematic", render_mode="rgb_array")
    env.reset(options={"start": (-1.0, 0.5, 0.0), "goal": (1.6, 2.6)})
    for _ in range(30):
        env.step([1.0, 1.0])
    picture = env.render()
    assert (picture.shape, picture.dtype) == ((480, 480, 3), np.uint8)
    assert pixel(picture, 1.6, 2.6) == GOAL[:3]
    assert pixel(picture, 3.0, 0.0) == OBSTACLE[:3]
    assert pixel(picture, 5.1, 0.0) == WALL[:3]
    assert pixel(picture, -4.5, 0.4) == FLOOR[:3]
    np.testing.assert_allclose(pixel(picture, -0.5, 0.5), TRAIL[:3], atol=60)
    assert sum(pixel(picture, 0.5, 0.64)) < 150
    env.step([1.0, 1.0])
    assert not np.array_equal(picture, env.render())


def test_without_a_render_mode_nothing_is_rendered() -> None:
    env = paper_env(physics="kinematic")
    env.reset(seed=0)
    assert env.render() is None


def test_trajectories_have_the_color_of_their_outcome() -> None:
    picture = render_trajectories(
        "A",
        [np.array([(-4.0, 0.03), (4.0, 0.03)]), [(-4.0, -2.97), (4.0, -2.97)]],
        [(4.0, 0.0), (4.0, 3.0)],
        ["success", "collision"],
        title="two",
    )
    assert picture.shape == (508, 480, 3)
    np.testing.assert_allclose(pixel(picture, 2.5, 0.03), OUTCOMES["success"][:3], atol=90)
    np.testing.assert_allclose(pixel(picture, 2.5, -2.97), OUTCOMES["collision"][:3], atol=90)


def test_walkers_are_shown_beside_the_paths() -> None:
    walkers = np.array([[1.0, 2.0, 0.3, 0.0, 0.25]])
    empty, walked = (render_trajectories("A", [], [], [], walkers=each) for each in (None, walkers))
    assert pixel(walked, 1.0, 1.85) != pixel(empty, 1.0, 1.85)
    assert pixel(walked, -1.0, 2.0) == pixel(empty, -1.0, 2.0)


def test_a_picture_shows_boxes_cylinders_and_polygons() -> None:
    dented = Polygon(((0.0, 0.0), (3.0, 0.0), (3.0, 3.0), (1.5, 1.0)))
    world = World(
        name="all",
        boxes=(Box(-3.0, -3.0, -1.0, -1.0),),
        cylinders=(Cylinder(2.0, -2.0, 0.7),),
        polygons=(dented,),
    )
    picture = render_trajectories(world, [], [], [])
    for x, y in ((-2.0, -2.0), (2.2, -2.2), (2.6, 1.3), (1.5, 0.4)):
        assert pixel(picture, x, y) == OBSTACLE[:3]
    for x, y in ((0.4, 0.7), (2.3, 2.5), (-1.5, 1.5)):
        assert pixel(picture, x, y) == FLOOR[:3]


def test_a_failure_ends_in_a_cross_or_hollow_square() -> None:
    paths = [[(-4, 0), (0, 0)]] * 2
    crossed, squared = (
        render_trajectories("A", paths[:1], [(4.0, 4.0)], [outcome])
        for outcome in ("collision", "timeout")
    )
    color = OUTCOMES["collision"][:3]
    assert [pixel(crossed, x, y) == color for x, y in ((0.07, 0.07), (0.1, 0.0))] == [True, False]
    color = OUTCOMES["timeout"][:3]
    assert pixel(squared, 0.04, 0.04) == (255, 255, 255)
    np.testing.assert_allclose(pixel(squared, 0.1, 0.0), color, atol=40)


def test_of_many_episodes_twenty_are_shown_and_all_are_counted() -> None:
    paths = [np.array([(-4.9 + 0.2 * n, -3.0), (-4.9 + 0.2 * n, 3.0)]) for n in range(48)]
    goals = [(-4.9 + 0.2 * n, 4.0) for n in range(48)]
    few, all_of_them = (
        render_trajectories("A", paths, goals, ["success"] * 48, most=most, goal_radius=0.01)
        for most in (20, 48)
    )
    blue = np.array(OUTCOMES["success"][:3])
    row = int(5.2 * 480 / 10.4)

    def lines(picture: np.ndarray) -> int:
        there = (abs(picture[row, 12:-12].astype(int) - blue).sum(-1) < 200).astype(int)
        return int((np.diff(there) == 1).sum())

    assert lines(few) == 20
    assert lines(all_of_them) == 48


def test_up_to_half_of_the_shown_episodes_are_failures() -> None:
    outcomes = ["success", "collision"] * 50
    shown = shown_episodes(outcomes, most=10)
    assert len(shown) == 10
    assert [outcomes[n] for n in shown].count("collision") == 5
    rare = shown_episodes(["success"] * 99 + ["timeout"], most=10)
    assert len(rare) == 10 and rare[-1] == 99
    assert shown_episodes(["timeout"] * 30, most=4) == [0, 10, 19, 29]
    assert shown_episodes(["timeout", "success"], most=10) == [0, 1]


def test_methods_stand_side_by_side_with_the_same_episodes() -> None:
    path, goals = [[(-4.0, 0.0), (4.0, 0.0)]], [(4.0, 0.0)]
    picture = render_methods(
        "A",
        {"one": path, "two": path},
        goals,
        {"one": ["success"], "two": ["collision"]},
        columns=2,
        size=480,
    )
    assert picture.shape == (508, 2 * 480 + 8, 3)
    left, right = pixel(picture, 0.0, 0.0), pixel(picture[:, 488:], 0.0, 0.0)
    np.testing.assert_allclose(left, OUTCOMES["success"][:3], atol=90)
    np.testing.assert_allclose(right, OUTCOMES["collision"][:3], atol=90)


def test_pictures_are_put_row_by_row_with_white_between_them() -> None:
    blacks = [np.full((10, 20, 3), 20 * n, np.uint8) for n in range(3)]
    whole = tiled(blacks, columns=2, gap=4)
    assert whole.shape == (24, 44, 3)
    assert whole[5, 5, 0] == 0 and whole[5, 30, 0] == 20 and whole[20, 5, 0] == 40
    assert whole[5, 22, 0] == whole[12, 5, 0] == whole[20, 30, 0] == 255


def test_an_animation_is_thinned_and_keeps_its_last_frame(tmp_path: Path) -> None:
    ramp = np.arange(40, dtype=np.uint8)[None, :, None].repeat(40, axis=0).repeat(3, axis=2) * 6
    frames = [np.roll(ramp, 3 * n, axis=1) for n in range(50)]
    write_animation(frames, tmp_path / "a.gif", frame_time=0.1, speed=1.0, most=10)
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.n_frames == 11
        assert animation.info["duration"] == 500
        animation.seek(10)
        shown = np.asarray(animation.convert("RGB")).astype(int)
        assert abs(shown - frames[-1]).max() <= 12


def test_a_second_robot_has_another_color() -> None:
    picture = render_scene(
        WORLDS["A"],
        robot=ROBOTS["turtlebot2"],
        pose=(0.0, 0.0, 0.0),
        goal=(4.0, 4.0),
        goal_radius=0.5,
        rival=((2.0, 0.0, np.pi), [(3.0, 0.0), (2.0, 0.0)]),
    )
    assert pixel(picture, 2.0, 0.15) == RIVAL[:3]
    np.testing.assert_allclose(pixel(picture, 2.6, 0.02), RIVAL[:3], atol=60)
