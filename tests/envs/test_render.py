from __future__ import annotations

import numpy as np
import pytest

from mpfa_envs import WORLDS, Box, Cylinder, Polygon, World, render_trajectories
from mpfa_envs.render import FLOOR, GOAL, OBSTACLE, OUTCOMES, TRAIL, WALL
from tests.envs.paper import paper_env


def pixel(picture: np.ndarray, x: float, y: float) -> tuple[int, ...]:
    """Color at a position [m] of a 10 x 10 m world."""
    scale = 480 / 10.4
    row, column = int((5.2 - y) * scale), int((x + 5.2) * scale)
    return tuple(picture[row, column].tolist())


def test_a_picture_shows_the_room_the_goal_the_robot_and_its_trail() -> None:
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


def test_walkers_are_shown_where_they_are_beside_the_ways() -> None:
    walkers = np.array([[1.0, 2.0, 0.3, 0.0, 0.25]])
    empty, walked = (render_trajectories("A", [], [], [], walkers=each) for each in (None, walkers))
    assert pixel(walked, 1.0, 1.85) != pixel(empty, 1.0, 1.85)
    assert pixel(walked, -1.0, 2.0) == pixel(empty, -1.0, 2.0)


def test_a_long_room_gives_a_long_picture() -> None:
    world = World(name="hall", size=(9.6, 4.6))
    assert render_trajectories(world, [], [], [], size=200).shape == (128, 200, 3)


def test_a_narrow_world_has_its_whole_legend_below_it() -> None:
    world = World(name="narrow", size=(2.6, 20.0))
    ends = ["success", "collision", "timeout"]
    picture = render_trajectories(world, [[]] * 3, [(0, 0)] * 3, ends, title="narrow", size=360)
    footer = picture[360:].astype(int)
    for color in OUTCOMES.values():
        assert (abs(footer - color[:3]).sum(-1) < 10).sum() > 50
    # Its last letter is whole: some white is beside it.
    assert (footer[:, -10:] == 255).all()
    dark = np.flatnonzero((picture[180] < 100).all(-1))
    left, right = dark[0], picture.shape[1] - 1 - dark[-1]
    assert abs(left - right) <= 1
    assert left > 100


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], [(0, 0)], []), "must have one entry per episode, got 0, 1 and 0"),
        (([[(0, 0)]], [(0, 0)], ["lost"]), "outcomes must be among .*got 'lost'"),
    ],
)
def test_bad_lists_are_refused(arguments: tuple[list, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        render_trajectories(WORLDS["A"], *arguments)


def test_a_bad_size_is_refused() -> None:
    with pytest.raises(ValueError, match="size must be an integer of at least 32, got 3"):
        render_trajectories("A", [], [], [], size=3)


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
