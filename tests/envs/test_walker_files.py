"""Walkers in files and as arguments: what comes back equal, and what is rejected."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from mpfa_envs import Walker, World, load_world, save_world
from tests.envs.busy import BUSY, ROUND, STANDING


def test_a_world_with_walkers_comes_back_equal(tmp_path: Path) -> None:
    save_world(BUSY, tmp_path / "busy.yaml")
    assert load_world(tmp_path / "busy.yaml") == BUSY
    assert hash(BUSY) == hash(replace(BUSY)) != hash(STANDING)
    (tmp_path / "short.yaml").write_text("size: [4, 4]\nwalkers:\n  - {speed: 0.2}\n")
    assert load_world(tmp_path / "short.yaml").walkers == (Walker(speed=0.2),)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("{radius: -1}", "busy.yaml:3: radius must be at least 0.01 m, got -1.0"),
        ("{speed: fast}", "busy.yaml:3: speed must be a number .*got 'fast'"),
        ("{behaviour: straight}", "busy.yaml:3: unknown key 'behaviour'.*did you mean 'behavior'"),
        ("{behavior: [1]}", r"busy.yaml:3: behavior must be text"),
        ("{behavior: waypoint}", "busy.yaml:3: behavior must be one of .*got 'waypoint'"),
        ("{behavior: waypoints, waypoints: [[0, 0], [9, 0]]}", "busy.yaml:3: walkers must keep"),
        ("{radius: 3}", "busy.yaml:3: walkers must fit in the room"),
    ],
)
def test_a_bad_walker_in_a_file_is_named_with_its_line(
    entry: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / "busy.yaml").write_text(f"size: [4, 4]\nwalkers:\n  - {entry}\n")
    with pytest.raises(ValueError, match=message):
        load_world(tmp_path / "busy.yaml")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Walker(radius=0.0), "radius must be at least 0.01 m, got 0.0"),
        (lambda: Walker(radius=1e-9), "radius must be at least 0.01 m, got 1e-09"),
        (lambda: Walker(radius=math.nan), "radius must be at least 0.01 m, got nan"),
        (lambda: Walker(speed=0.0), "speed must be above 0 and at most 5, got 0.0"),
        (lambda: Walker(speed=9.0), "speed must be above 0 and at most 5, got 9.0"),
        (lambda: Walker(radius="wide"), "radius must be at least 0.01 m, got 'wide'"),
        (lambda: Walker(speed=None), "speed must be above 0 and at most 5, got None"),
        (lambda: Walker(behavior="orca", waypoints=3), "waypoints must be a list of .*got 3"),
        (lambda: Walker(behavior="orca", waypoints=(1, 2)), r"waypoints must be .*got \(1, 2\)"),
        (
            lambda: Walker(behavior="orca", waypoints=(("1", 2), (3, 4))),
            r"waypoints must be finite positions \(x, y\), got .*'1'",
        ),
        (lambda: Walker(behavior="fly"), "behavior must be one of .*got 'fly'"),
        (lambda: Walker(waypoints=ROUND), "waypoints must be empty with behavior='straight'"),
        (lambda: Walker(behavior="waypoints"), "waypoints must be 2 to 100 .*got 0"),
        (
            lambda: Walker(behavior="waypoints", waypoints=((0, 0), (0, 0), (1, 1))),
            r"waypoints must differ from the ones before them, got \(0.0, 0.0\)",
        ),
        (
            lambda: Walker(behavior="waypoints", waypoints=((0, 0), (1e-9, 0))),
            r"waypoints must differ from the ones before them, got \(0.0, 0.0\) and \(1e-09, 0.0\)",
        ),
        (
            lambda: Walker(behavior="waypoints", waypoints=((0, 0), (math.inf, 0))),
            "waypoints must be finite",
        ),
        (
            lambda: replace(
                BUSY, walkers=(Walker(behavior="waypoints", waypoints=((0, 2), (3, 2))),)
            ),
            r"walkers must keep their radius .* from \(0.0, 2.0\) to \(3.0, 2.0\)",
        ),
        (lambda: World(name="many", walkers=(Walker(),) * 101), "walkers must be at most 100, got"),
    ],
)
def test_a_bad_walker_is_rejected(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
