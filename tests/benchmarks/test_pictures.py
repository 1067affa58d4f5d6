"""The pictures of the documentation show what the text beside them says."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks import pictures
from benchmarks.speed.worlds import course_of
from mpfa_envs import load_policy
from mpfa_envs.render import drive_episode
from mpfa_envs.worlds.barn import barn_world
from training.evaluating import filtered
from training.pictures import longest

DOCS = Path(__file__).parents[2] / "docs"
ANIMATION = DOCS / "images/pictures/episode.gif"


@pytest.mark.slow
def test_the_animation_of_the_readme_ends_in_the_goal() -> None:
    driver = filtered(load_policy(pictures.SHIPPED))
    number, task = pictures.filmed(driver)
    for step in drive_episode(driver, task, seed=number, physics=pictures.PHYSICS):
        if step.wheels is None:
            (last,), reached = step.env.render(), step.info["success"]
    assert reached.all()
    with Image.open(ANIMATION) as animation:
        animation.seek(animation.n_frames - 1)
        shown = np.asarray(animation.convert("RGB")).astype(int)
    # But for the colors of a palette, it is the end of this drive.
    assert shown.shape == last.shape
    assert abs(shown - last).mean() < 3.0


def test_a_film_shows_the_longest_success_that_fits() -> None:
    lengths = ((3.0, True), (14.0, True), (15.0, False), (60.0, True))
    results = [SimpleNamespace(path_length=each, success=reached) for each, reached in lengths]
    driven: Any = [SimpleNamespace(results=results, tasks=list("abcd"))]
    assert longest(driven, most=15.0) == (1, "b")
    assert longest(driven) == (3, "d")


def test_a_world_of_barn_is_pictured_without_its_empty_corridor() -> None:
    course = course_of(barn_world(8))
    width, depth = course.size
    inside = sorted(each.y for each in course.cylinders if abs(each.x) < width / 2 - 0.5)
    assert -depth / 2 < inside[0] < 1.0 - depth / 2
    assert np.diff(inside).max() < 1.0


def test_the_animation_of_the_readme_is_small_enough_for_a_page() -> None:
    assert ANIMATION.stat().st_size < 3_000_000


@pytest.mark.parametrize(
    "path",
    [
        *DOCS.glob("images/*.png"),
        *(
            DOCS / f"images/pictures/{name}.png"
            for name in ("methods", "rooms", "samples", "values")
        ),
    ],
    ids=lambda path: path.stem,
)
def test_words_of_13_pixels_can_be_read_in_a_column_of_690(path: Path) -> None:
    with Image.open(path) as picture:
        assert 13 * min(690 / picture.width, 1) > 10.5
