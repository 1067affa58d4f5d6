"""Where a run learns and where its policy is judged."""

from __future__ import annotations

import math
from argparse import ArgumentTypeError
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import nn

from evaluate import read_noise
from mpfa_envs import (
    ROBOTS,
    Mirror,
    NavigationEnv,
    Policy,
    RandomMirror,
    RobotNoise,
    TaskConfig,
    load_policy,
)
from mpfa_envs.policies.layers import Tanh
from tests.integration.settings.test_settings import hydra_at_rest, one  # noqa: F401
from tests.integration.tiny_runs import tiny, train
from training.environments import env_arguments, make_training_env, vector_of
from training.run.assembly import make_learner, policy_layers
from training.run.driving import Robots
from training.settings.command_line import composed
from training.settings.environment import EnvironmentSettings, NoiseSettings
from training.settings.train import REGIMES, Stage, curriculum_name


@pytest.mark.parametrize(
    ("robot", "radius", "nearest"), [("turtlebot2", 0.18, 0.28), ("burger", 0.105, 0.105)]
)
def test_a_robot_learns_with_a_clearance(robot: str, radius: float, nearest: float) -> None:
    settings = EnvironmentSettings(
        robot=robot, physics="kinematic", clearance=0.1, progress_scale=3.0
    )
    training = make_training_env("C", settings)
    assert training.env.config.collision_distance == pytest.approx(radius + 0.1)
    assert env_arguments(settings)["closeness_distance"] == pytest.approx(nearest)
    training.close()


def test_standing_still_costs_what_the_settings_say() -> None:
    settings = EnvironmentSettings(robot="kobuki", physics="kinematic", step_cost=0.05)
    training = make_training_env("C", settings)
    training.set_seed(1)
    state = training.reset()
    state["action"] = torch.zeros(1, 2)
    assert training.step(state)["next", "reward"].item() == pytest.approx(-0.1)
    training.close()


class Ahead:
    """Acts straight on, whatever it sees."""

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.ones(len(observation), 2)

    def behavior(self) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.ones(1), torch.ones(1)

    def begin_episodes(self, begun: torch.Tensor) -> None: ...


@pytest.mark.parametrize(("random_steps", "share"), [(0, 1.0), (0, 0.3), (10_000, 1.0)])
def test_what_the_filter_lets_pass_is_carried_out_and_stored(
    random_steps: int, share: float
) -> None:
    settings = tiny(robots=8)
    settings.exploration.random_steps = random_steps
    settings.environment = EnvironmentSettings(
        robot="kobuki", physics="kinematic", filter=share, clearance=0.0
    )
    robots = Robots(settings)
    keep = TaskConfig(**env_arguments(settings.environment)).make_filter()
    some = 8 if share == 1.0 else 3
    robots.begin("mazes", Ahead(), seed=1)
    changed = collisions = 0
    for step in range(150):
        data, records = robots.drive(Ahead(), actions=8 * step, episode=0)
        seen, action = data["observation"].numpy(), data["action"].numpy()
        assert np.array_equal(keep(seen[:some], action[:some]), action[:some])
        changed += int((action != 1.0).any(axis=1)[:some].sum())
        if not random_steps:
            assert (action[some:] == 1.0).all()
        collisions += sum(record.collision for record in records)
    robots.close()
    assert changed > 20
    assert (collisions > 0) == (some < 8)


def test_with_a_cost_what_was_chosen_is_stored_and_what_the_filter_changed_is_charged() -> None:
    settings = tiny(robots=8)
    settings.exploration.random_steps = 0
    free = EnvironmentSettings(robot="kobuki", physics="kinematic", filter=0.6, step_cost=0.05)
    driven: dict[float | None, Any] = {}
    for cost in (None, 0.0, 0.5):
        settings.environment = replace(free, filter_cost=cost)
        robots = Robots(settings)
        robots.begin("mazes", Ahead(), seed=1)
        steps = [robots.drive(Ahead(), actions=8 * step, episode=0)[0] for step in range(60)]
        driven[cost] = torch.stack(steps)
        robots.close()
    without, free_of_cost, charged = driven[None], driven[0.0], driven[0.5]
    assert torch.equal(charged["next", "observation"], without["next", "observation"])
    assert (charged["action"] == 1.0).all() and (free_of_cost["action"] == 1.0).all()
    assert torch.equal(free_of_cost["next", "reward"], without["next", "reward"])
    change = (without["action"] - 1.0).abs().amax(-1, keepdim=True)
    paid = without["next", "reward"] - charged["next", "reward"]
    assert paid == pytest.approx(0.5 * change, abs=1e-6)
    assert change[:, :5].count_nonzero() > 20 and not change[:, 5:].any()


@pytest.mark.parametrize(
    ("robot", "repeat"),
    [("kobuki", 2), ("turtlebot2", 2), ("turtlebot4", 4), ("waffle", 5), ("burger", 6)],
)
def test_a_slow_robot_holds_an_action_as_far_as_a_fast_one_drives(robot: str, repeat: int) -> None:
    chosen = EnvironmentSettings(robot=robot, action_repeat=None)
    assert env_arguments(chosen)["action_repeat"] == repeat
    assert env_arguments(replace(chosen, action_repeat=3))["action_repeat"] == 3
    fast = replace(ROBOTS["kobuki"], max_wheel_speed=2.0)
    assert env_arguments(replace(chosen, robot=fast))["action_repeat"] == 2


def test_it_senses_alike_where_it_learns_and_where_it_is_judged() -> None:
    settings = EnvironmentSettings(
        physics="kinematic", clearance=0.1, max_steps=40, action_repeat=3
    )
    training = make_training_env("D", settings)
    judging = NavigationEnv(world="D", contact=True, **env_arguments(settings))
    training.set_seed(1)
    seen = training.reset()["observation"].numpy()[0]
    task = training.env.tasks[0]
    assert judging.reset(options=task._asdict())[0] == pytest.approx(seen)
    for name in ("action_repeat", "closeness_distance", "physics"):
        assert getattr(judging.config, name) == getattr(training.env.config, name)
    assert judging.config.closeness_distance == pytest.approx(0.28)
    training.close()
    judging.close()


def test_a_lidar_that_sees_a_whole_turn_is_asked_for_and_mirrored(tmp_path: Path) -> None:
    assert "lidar" not in env_arguments(EnvironmentSettings())
    settings = tiny()
    settings.environment.field_of_view, settings.environment.history = 360.0, 1
    run = train(tmp_path / "run", settings)
    lidar = load_policy(run.folder / "policy.npz").env_arguments["lidar"]
    assert lidar == {"field_of_view": 360.0, "sectors": 36}
    batch = run.buffer[:40]["observation"]
    assert batch.shape[-1] == 36 + 6 + 36
    mirror = Mirror(sectors=36, history=1)
    transform = next(each for each in run.buffer._transform if isinstance(each, RandomMirror))
    assert torch.equal(transform.mirrors[0].observation(batch), mirror.observation(batch))


def test_the_settings_of_a_run_start_from_the_defaults_of_the_environment() -> None:
    training = make_training_env("B", EnvironmentSettings(physics="kinematic"))
    expected = TaskConfig(physics="kinematic")
    assert training.env.config == expected
    assert EnvironmentSettings().physics == TaskConfig().physics == "wheels"
    training.close()


@pytest.mark.parametrize(
    ("env_id", "world", "changed"),
    [
        ("mpfa/Navigation-D-v1", "D", {"physics": "kinematic"}),
        ("mpfa/Rooms-v1", "mixed", REGIMES["rooms"]["environment"]),
    ],
)
def test_the_ids_are_the_tasks_that_the_regimes_learn(
    env_id: str, world: str, changed: dict[str, Any]
) -> None:
    trained = vector_of(make_training_env(world, EnvironmentSettings(**changed), robots=2))
    made = gymnasium.make_vec(env_id, num_envs=2, physics="kinematic")
    for env in (trained, made):
        env.reset(seed=1)
    assert made.tasks == trained.tasks
    assert made.worlds == trained.worlds
    mine, theirs = (env.state_dict()["arguments"] for env in (made, trained))
    # When robots are reset is decided by whoever steps them.
    for arguments in (mine, theirs):
        del arguments["autoreset_mode"]
        assert arguments.pop("lidar.mount") == [0.0, 0.0]
    # The regime scales the closeness of a robot that can stop by its radius alone.
    theirs["closeness_distance"] += changed.get("clearance", 0.0)
    assert mine == pytest.approx(theirs)
    assert made._source._max_goal_distance == trained._source._max_goal_distance
    trained.close()
    made.close()


def test_the_settings_of_noise_are_those_of_the_environment() -> None:
    settings = EnvironmentSettings(
        physics="kinematic", noise=NoiseSettings(slip=0.1), latency=[0.0, 0.2]
    )
    env = make_training_env("A", settings, robots=2)
    assert vector_of(env).config.noise == RobotNoise(slip=0.1)
    assert vector_of(env).config.latency == (0.0, 0.2)
    env.close()


def test_noise_on_the_command_line_is_read_or_rejected() -> None:
    assert read_noise("slip=0.1,drift=0.2") == RobotNoise(slip=0.1, drift=0.2)
    for words in ("slip=2", "slip", "latency=0.5", "wind=1"):
        with pytest.raises(ArgumentTypeError):
            read_noise(words)


@pytest.mark.parametrize("limit", [0.5, 1.5, 3.0])
@pytest.mark.parametrize("algorithm", ["ddpg", "td3", "sac"])
def test_every_learner_has_the_full_range_of_actions_at_the_limit(
    algorithm: str, limit: float
) -> None:
    words = [f"learner={algorithm}", f"learner.saturation_limit={limit}", "learner.compile=false"]
    for more, reached in (([], 1.0), (["learner.full_range=false"], math.tanh(limit))):
        settings = one(*words, *more)
        policy = make_learner(settings.learner, settings.method, 5, 2).policy
        head = next(each for each in reversed(policy.layers()) if isinstance(each, nn.Linear))
        with torch.no_grad():
            head.weight.zero_()
            head.bias.copy_(torch.tensor([limit, -limit]))
        action = Policy(policy_layers(policy))(np.zeros(5, np.float32))
        np.testing.assert_allclose(action, [reached, -reached], rtol=1e-6)


def test_the_paper_has_the_tanh_alone() -> None:
    settings = one("regime=paper")
    policy = make_learner(settings.learner, settings.method, 5, 2).policy
    assert [type(each) for each in policy_layers(policy)][-1] is Tanh


@pytest.mark.parametrize(
    ("words", "stages"),
    [
        (["actions=7000"], [Stage("mixed", actions=7_000)]),
        (["actions=7000", "curriculum.stages=[{world: bars}]"], [Stage("bars", actions=7_000)]),
        (
            ["actions=1000", "regime=paper"],
            [
                Stage(world, actions=n)
                for world, n in zip("ABCD", (100, 200, 300, 400), strict=True)
            ],
        ),
        (
            ["actions=10", "curriculum.stages=[{world: A, actions: 2}, {world: B, actions: 1}]"],
            [Stage("A", actions=6), Stage("B", actions=4)],
        ),
    ],
)
def test_stages_share_the_actions_of_a_run_in_proportion(words, stages) -> None:
    [settings] = composed(words)
    assert settings.curriculum.stages == stages
    assert settings.curriculum.name == curriculum_name(stages)
    assert f"/{curriculum_name(stages)}-" in settings.run_dir


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["actions=3", "regime=paper"], "actions must leave each stage at least 1, got 3"),
        (["actions=0"], "actions must leave each stage at least 1, got 0"),
        (["actions=many"], "actions: Value 'many'"),
        (["actions=9", "curriculum.stages=[]"], "curriculum.stages must name at least one world"),
    ],
)
def test_a_length_that_a_run_cannot_have_is_rejected(words, message) -> None:
    with pytest.raises(ValueError, match=message):
        list(composed(words))
