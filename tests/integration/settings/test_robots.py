"""A robot of a file in the settings of a run, which holds its values from then on."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from mpfa_envs import EXAMPLE_ROBOT, TaskConfig, evaluate, load_policy, load_robot
from mpfa_envs.robots.resolve import resolve_robot
from tests.integration.tiny_runs import OVERRIDES, go_on, rows, stop_after, tiny, train
from training.environments import env_arguments
from training.run.checkpoints import read_checkpoint
from training.run.script import write_settings
from training.settings.command_line import composed
from training.settings.train import TrainSettings, as_settings, register

CART = load_robot(EXAMPLE_ROBOT)


def asked(file: Path) -> TrainSettings:
    register()
    (settings,) = composed([*OVERRIDES, f"environment.robot={file}"])
    return settings


def test_settings_hold_the_values_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "cart.yaml"
    file.write_bytes(EXAMPLE_ROBOT.read_bytes())
    settings = asked(file)
    assert resolve_robot(settings.environment.robot) == CART
    file.unlink()
    write_settings(settings, tmp_path / "settings.json")
    for saved in (asdict(settings), json.loads((tmp_path / "settings.json").read_text())):
        assert as_settings(saved).environment == settings.environment


def test_an_error_in_the_file_names_the_setting_and_the_line(tmp_path: Path) -> None:
    file = tmp_path / "cart.yaml"
    text = EXAMPLE_ROBOT.read_text(encoding="utf-8").replace("radius: 0.28", "radius: -0.28")
    file.write_text(text, encoding="utf-8")
    message = r"environment.robot: .*cart.yaml:3: radius must be positive, got -0.28"
    with pytest.raises(ValueError, match=message):
        asked(file)
    with pytest.raises(ValueError, match=r"environment.robot: .*none.yaml: cannot be read"):
        asked(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "view: 360",
            "view: 90",
            r"environment.field_of_view must be at least 180 degrees for a f",
        ),
        ("[0.1, 0.0", "[0.1, 0.05", "environment.mirror must be False for 'cart', whose lidar is"),
    ],
)
def test_a_lidar_that_does_not_fit_the_training_is_named_before_it_starts(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "cart.yaml"
    text = EXAMPLE_ROBOT.read_text(encoding="utf-8").replace(old, new)
    file.write_text(text, encoding="utf-8")
    register()
    words = [f"environment.robot={file}", "regime=rooms", "learner=td3", "actions=100"]
    with pytest.raises(ValueError, match=message):
        next(iter(composed(words)))
    for settings in composed([*words, "environment.filter=0", "environment.mirror=false"]):
        assert settings.environment.filter == 0.0


def test_a_policy_asks_for_plan_and_goal_radius_where_they_are_not_the_defaults() -> None:
    register()
    words = ["regime=rooms", "learner=td3", "actions=100"]
    for more, asked in (([], {}), (["plan=known", "goal_radius=0.1"], {"plan", "goal_radius"})):
        (settings,) = composed([*words, *(f"environment.{each}" for each in more)])
        arguments = env_arguments(settings.environment)
        assert arguments.keys() & {"plan", "goal_radius"} == set(asked)
        assert TaskConfig(**arguments).goal_radius == (0.1 if more else 0.5)
    with pytest.raises(ValueError, match=r"environment.goal_radius must be from 0.1 to 1.5"):
        next(iter(composed([*words, "environment.goal_radius=0.05"])))


def test_a_run_resumes_and_its_policy_drives_without_the_file(tmp_path: Path) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    settings = tiny()
    settings.environment.robot = asdict(CART)
    stop_after(30, broken, settings)
    saved = as_settings(read_checkpoint(broken)["settings"])
    assert saved.environment == settings.environment
    assert rows(go_on(broken, saved)) == rows(train(whole, settings))
    policy = load_policy(broken)
    assert resolve_robot(policy.env_arguments["robot"]) == CART
    assert policy.observation_size == 36 + 6
    assert evaluate(policy, "A", episodes=2) == evaluate(policy, "A", episodes=2, robot=CART)
