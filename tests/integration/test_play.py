"""A race by keyboard, and episodes in a window, where nothing is seen."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evaluate
import play
from mpfa_envs import Policy, world_tasks
from mpfa_envs.policies.layers import Linear
from mpfa_envs.robots.model import ROBOTS
from mpfa_envs.scene.colors import RIVAL, ROBOT
from training import pictures
from training.pictures import watch

pygame = pytest.importorskip("pygame")


def constant(left: float, right: float) -> Policy:
    """A policy that holds one action."""
    bias = np.array([left, right], np.float32)
    env_arguments = {"robot": "turtlebot2", "physics": "kinematic", "max_steps": 40}
    return Policy([Linear(np.zeros((2, 24), np.float32), bias)], env_arguments=env_arguments)


class Script:
    """A window whose keys are written down."""

    def __init__(self, *keys: str) -> None:
        self.keys, self.pressed, self.closed = set(keys), [], False
        self.pictures: list[Any] = []

    def show(self, picture: Any) -> bool:
        self.pictures.append(picture)
        return not self.closed


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


def straight_task() -> Any:
    """A goal two meters straight ahead."""
    task = world_tasks("A", episodes=1)[0]
    return task._replace(task=task.task._replace(start=(-2.0, 0.0, 0.0), goal=(0.0, 0.0)))


@pytest.mark.parametrize(
    ("keys", "rival", "winner"),
    [
        (["up"], (-1.0, -1.0), "you"),
        ([], (1.0, 1.0), "policy"),
        (["w"], (1.0, 1.0), "nobody"),
        (["left"], (1.0, -1.0), "nobody"),
    ],
)
def test_who_is_first_at_the_goal_wins(
    keys: list[str], rival: tuple[float, float], winner: str
) -> None:
    window = Script(*keys)
    assert play.race(constant(*rival), straight_task(), window) == winner
    assert len(window.pictures) > 5


def test_both_robots_are_drawn() -> None:
    window = Script("left")
    play.race(constant(1.0, 1.0), straight_task(), window)
    last = window.pictures[-1].reshape(-1, 3)
    for color in (ROBOT, RIVAL):
        assert (last == color[:3]).all(1).sum() > 100


@pytest.mark.parametrize(
    ("robot", "keys", "action"),
    [
        ("turtlebot2", [], (-1.0, -1.0)),
        ("turtlebot2", ["up"], (1.0, 1.0)),
        ("turtlebot2", ["w"], (1.0, 1.0)),
        ("turtlebot2", ["left"], (-1.0, 1.0)),
        ("turtlebot2", ["d"], (1.0, -1.0)),
        ("turtlebot2", ["up", "left"], (0.3, 1.0)),
        ("turtlebot2", ["up", "left", "right"], (1.0, 1.0)),
        ("kobuki", [], (0.0, 0.0)),
        ("kobuki", ["s"], (-1.0, -1.0)),
        ("kobuki", ["left"], (-0.3, 0.3)),
        ("kobuki", ["up", "right"], (1.0, 0.3)),
    ],
)
def test_keys_are_wheel_speeds(robot: str, keys: list[str], action: tuple[float, float]) -> None:
    assert play.action_of(keys, ROBOTS[robot]) == pytest.approx(action)


@pytest.mark.parametrize(("words", "name"), [([], "kobuki"), (["--robot", "waffle"], "waffle")])
def test_both_drive_the_robot_of_the_policy_or_another(
    words: list[str], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven: list[Any] = []
    monkeypatch.setattr(play, "race", lambda policy, *_, **how: driven.append(policy))
    play.main(["td3-rooms", "--worlds", "A", "--races", "1", *words])
    assert [policy.env_arguments["robot"]["name"] for policy in driven] == [name]


def test_episodes_are_watched_to_their_ends() -> None:
    task = straight_task()
    ended = list(watch(constant(1.0, 1.0), [task] * 2, speed=100.0))
    assert [(end.world, end.outcome) for end in ended] == [("A", "success")] * 2
    assert ended[0].time_s == pytest.approx(3.0, abs=0.2)


def test_the_evaluation_is_shown_live_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        pictures, "watch", lambda policy, tasks, **how: watch(policy, tasks, speed=100.0, **how)
    )
    monkeypatch.setattr(evaluate, "load_policy", lambda path: constant(-1.0, -1.0))
    words = ["--worlds", "A", "--episodes", "1", "--live", "--output", str(tmp_path / "out")]
    shown = evaluate.main(["some.npz", *words])
    assert len(shown) == 1
    assert "A: timeout after 4.0 s" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


def test_without_a_screen_nobody_races(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pygame.display.quit()
    monkeypatch.delenv("SDL_VIDEODRIVER")
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")
    with pytest.raises(SystemExit) as ended:
        play.main([])
    assert ended.value.code == 2
    assert "there is no screen" in capsys.readouterr().err
