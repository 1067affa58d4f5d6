"""What scripts tell of what they have understood, and of runs that are not what one expects."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pytest

from mpfa_envs import EXAMPLE_ROBOT, Box, World, save_world
from tests.integration.run.test_runs import begin
from training import extra, files
from training.finished import warnings_of
from training.worlds import narrowest_door, understood


def parted(door: float, size: tuple[float, float] = (12.0, 8.0)) -> World:
    """Two rooms and a door in the wall between them."""
    edge = size[1] / 2
    walls = Box(-0.1, -edge, 0.1, -door / 2), Box(-0.1, door / 2, 0.1, edge)
    return World(name="flat", size=size, boxes=walls)


@pytest.mark.parametrize("door", [0.4, 0.6, 0.95, 1.5])
def test_the_width_of_the_narrowest_door_is_found(door: float) -> None:
    assert narrowest_door(parted(door)) == pytest.approx(door, abs=0.051)


@pytest.mark.parametrize(
    "world",
    [
        World(name="empty"),
        parted(0.0),
        World(name="niche", boxes=(Box(-5, 4.5, -1, 5), Box(-0.5, 4.5, 5, 5))),
        World(name="field", size=(500.0, 300.0)),
    ],
)
def test_a_world_without_a_door_between_two_rooms_has_none(world: World) -> None:
    assert narrowest_door(world) is None


def test_a_robot_and_worlds_from_files_are_told_in_one_line(tmp_path: Path) -> None:
    save_world(parted(0.9), tmp_path / "flat.yaml")
    line = understood(EXAMPLE_ROBOT, [str(tmp_path / "flat.yaml"), "bars:test", "bars:test"])
    assert line == "cart: 0.56 m wide, 0.9 m/s; flat: 12.0 x 8.0 m, doors from 0.90 m; bars:test"


def test_a_run_without_an_update_says_so_and_names_no_picture_that_is_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["curriculum.stages=[{world: A, actions: 5}]", "environment.max_steps=200"]
    assert begin(tmp_path, *words, "method.batch_size=100") == 0
    said = capsys.readouterr().out
    assert "turtlebot2: 0.36 m wide, 0.5 m/s; A; validation" in said
    assert "no update was made in 5 actions, as the first update needs 100; give more" in said
    assert files.CURVE not in said and not (tmp_path / files.CURVE).exists()
    assert warnings_of(tmp_path) == [
        "nothing was learned: no update was made in 5 actions; give more actions"
    ]


@pytest.mark.parametrize(
    ("status", "said"),
    [
        ({"done": 24_000, "finished": False}, ["RUN is not finished: 24,000 of 36,000 actions"]),
        ({"done": 36_000, "finished": True}, []),
    ],
)
def test_a_run_that_is_not_finished_is_told(
    tmp_path: Path, status: dict[str, object], said: list[str]
) -> None:
    whole = {"unit": "action", "total": 36_000, "steps": 1, "updates": 9, **status}
    (tmp_path / files.STATUS).write_text(json.dumps(whole))
    assert [each.replace(str(tmp_path), "RUN") for each in warnings_of(tmp_path)] == said


def test_a_folder_without_a_status_is_told_nothing_of(tmp_path: Path) -> None:
    assert warnings_of(tmp_path) == []


def test_a_warning_of_the_project_is_shown_once_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "map.pgm").write_bytes(b"P5 3 3 255\n" + bytes([254] * 8 + [205]))
    values = "resolution: 1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\n"
    (tmp_path / "map.yaml").write_text(f"image: map.pgm\n{values}free_thresh: 0.25\n")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        monkeypatch.setattr(warnings, "showwarning", extra.show_once)
        for _ in range(3):
            understood("kobuki", [str(tmp_path / "map.yaml")])
        warnings.warn("of another package", stacklevel=1)
    ours = [line for line in capsys.readouterr().err.splitlines() if "free_thresh" in line]
    assert len(ours) == 1 and ours[0].startswith(f"warning: {tmp_path}/map.yaml:6: free_thresh")
