from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    EnvBase,
    EnvCreator,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from mpfa_envs import NavigationEnv, NavigationTorchEnv, RobotNoise, make_navigation_env
from mpfa_envs.sensing.observation import INFO_TYPES
from mpfa_envs.tasks.sampling import evaluation_pairs


@pytest.mark.parametrize("num_envs", [None, 3])
def test_the_specs_hold(num_envs: int | None, physics: str) -> None:
    env = make_navigation_env("B", num_envs=num_envs, physics=physics, seed=0)
    check_env_specs(env)
    batch = [] if num_envs is None else [num_envs]
    assert list(env.batch_size) == batch
    rollout = env.rollout(4)
    assert rollout["observation"].shape == (*batch, 4, 24)
    assert rollout["observation"].dtype == torch.float32
    for name, kind in INFO_TYPES.items():
        value = rollout["next", "info", name]
        assert value.shape == (*batch, 4, 1)
        assert value.dtype == (torch.bool if kind is bool else torch.float32)
    env.close()
    env.close()


@pytest.mark.slow  # Each process imports PyTorch and TorchRL.
@pytest.mark.parametrize("num_envs", [1, 2])
def test_parallel_environments_have_the_same_face(num_envs: int) -> None:
    env = make_navigation_env("A", num_envs=num_envs, parallel=True, physics="kinematic", seed=0)
    try:
        assert env.rollout(3)["next", "info", "distance"].shape == (num_envs, 3, 1)
    finally:
        env.close()


@pytest.mark.parametrize("num_envs", [None, 2])
def test_a_seed_gives_the_same_episodes_again(num_envs: int | None) -> None:
    env = make_navigation_env("C", num_envs=num_envs, physics="kinematic")
    rollouts = []
    for _ in range(2):
        env.set_seed(3)
        torch.manual_seed(0)
        rollouts.append(env.rollout(20, break_when_any_done=False))
    assert (rollouts[0] == rollouts[1]).all()
    if num_envs:
        assert not torch.equal(rollouts[0]["observation"][0], rollouts[0]["observation"][1])


def as_serial() -> SerialEnv:
    return SerialEnv(1, lambda: NavigationTorchEnv(num_envs=2, world="bars", physics="kinematic"))


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_navigation_env("bars", physics="kinematic"),
        lambda: make_navigation_env("bars", num_envs=2, physics="kinematic"),
        lambda: TransformedEnv(make_navigation_env("bars", physics="kinematic"), StepCounter()),
        as_serial,
    ],
    ids=["one", "two", "transformed", "serial"],
)
def test_a_reset_with_a_seed_equals_set_seed_and_reset(make: Callable[[], EnvBase]) -> None:
    env, other = make(), make()
    first, again = env.reset(seed=3), env.reset(seed=3)
    assert torch.equal(first["observation"], again["observation"])
    assert not torch.equal(env.reset()["observation"], first["observation"])
    if not isinstance(env, SerialEnv):  # It counts on from worker to worker.
        other.set_seed(3)
        assert torch.equal(other.reset()["observation"], first["observation"])
    with pytest.raises(TypeError, match="unexpected keyword argument 'foo'"):
        env.reset(foo=1)
    with pytest.raises(ValueError, match="seed must be an integer of at least 0, got -1"):
        env.reset(seed=-1)
    env.close()


def test_a_seed_is_for_the_robots_that_a_reset_names() -> None:
    env = make_navigation_env("bars", num_envs=2, physics="kinematic", seed=0)
    env.reset()
    mask = TensorDict({"_reset": torch.tensor([[False], [True]])}, [2])
    before, first = env.env.poses, env.reset(mask.clone(), seed=3)["observation"]
    assert torch.equal(env.reset(mask.clone(), seed=3)["observation"], first)
    assert (env.env.poses == before).all(axis=1).tolist() == [True, False]


def test_a_time_limit_is_truncated_and_a_collision_terminated() -> None:
    env = make_navigation_env("A", physics="kinematic", max_steps=4, action_repeat=1, seed=0)
    env.set_task((0.0, 0.0, 0.0), (3.0, 3.0))
    last = env.rollout(10)[-1]["next"]
    assert (last["truncated"].item(), last["terminated"].item(), last["done"].item()) == (1, 0, 1)
    env.set_task((4.7, 0.0, 0.0), (-3.0, 3.0))
    last = env.rollout(10)[-1]["next"]
    assert (last["truncated"].item(), last["terminated"].item(), last["done"].item()) == (0, 1, 1)
    assert last["info", "collision"].item() and last["reward"].item() == -5.0


def test_a_task_holds_for_the_next_episode_only() -> None:
    env = make_navigation_env("test", num_envs=2, physics="kinematic", seed=0)
    pair = evaluation_pairs("test", 1, seed=0)[0]
    env.set_task(*pair, index=1)
    x = env.reset()["info", "x"]
    assert x[1].item() == pytest.approx(pair.start[0]) and x[0].item() != x[1].item()
    assert env.reset()["info", "x"][1].item() != pytest.approx(pair.start[0])
    with pytest.raises(IndexError, match=r"index must be in \[0, 2\), got 2"):
        env.set_task(*pair, index=2)
    with pytest.raises(ValueError, match="start must be farther"):
        env.set_task((5.0, 0.0, 0.0), (0.0, 0.0))


def test_a_rollout_can_wait_for_the_last_episode() -> None:
    env = make_navigation_env("A", num_envs=2, physics="kinematic", action_repeat=1, seed=0)
    env.set_task((0.0, 0.0, 0.0), (1.0, 0.0), index=0)
    env.set_task((0.0, 0.0, 0.0), (2.0, 0.0), index=1)

    def ahead(tensordict):
        return tensordict.set("action", torch.ones(2, 2))

    rollout = env.rollout(
        100, ahead, break_when_any_done=False, break_when_all_done=True, auto_reset=True
    )
    success = rollout["next", "info", "success"].any(dim=1)
    assert success.all() and rollout.shape[1] in (30, 31)


def test_the_usual_transforms_and_the_collector_work() -> None:
    env = TransformedEnv(
        make_navigation_env("B", physics="kinematic", max_steps=10, seed=0),
        Compose(StepCounter(), RewardSum()),
    )
    rollout = env.rollout(10)
    total = rollout["next", "episode_reward"][-1]
    assert total.item() == pytest.approx(rollout["next", "reward"].sum().item(), rel=1e-5)
    collector = Collector(env, None, frames_per_batch=32, total_frames=64)
    batches = [batch.numel() for batch in collector]
    collector.shutdown()
    assert batches == [32, 32]


def test_loading_a_state_of_torchrl_warns_that_robots_stay() -> None:
    env = NavigationTorchEnv(num_envs=2, world="bars", physics="kinematic")
    twin = NavigationTorchEnv(num_envs=2, world="bars", physics="kinematic")
    other = TransformedEnv(twin, StepCounter())
    state = env.reset(seed=0)
    with pytest.warns(UserWarning, match=r"save env\.env\.state_dict\(\), and load it with env\."):
        env.load_state_dict(env.state_dict())
    other.reset()
    other.base_env.env.load_state_dict(env.env.state_dict())
    for _ in range(5):
        actions = state.select("observation").set("action", torch.full((2, 2), 0.7))
        state, again = env.step(actions.clone())["next"], other.base_env.step(actions)["next"]
        assert (state == again).all()


# A creator gives each environment the state of a first one; with its robots, all would be alike.
def test_environments_of_a_creator_start_at_random_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        create = EnvCreator(partial(NavigationTorchEnv, world="A", physics="kinematic"))
        first, second = create(), create()
    assert not torch.equal(first.reset()["observation"], second.reset()["observation"])


def test_what_was_collected_does_not_change_with_the_next_step() -> None:
    env = make_navigation_env("A", physics="kinematic", seed=0)
    first = env.reset()
    kept = first["observation"].clone()
    env.step(first.set("action", torch.ones(2)))
    assert torch.equal(first["observation"], kept)


def test_info_keys_choose_what_is_handed_on() -> None:
    env = make_navigation_env("A", physics="kinematic", info_keys=("success", "distance"))
    check_env_specs(env)
    assert set(env.reset()["info"].keys()) == {"success", "distance"}
    bare = make_navigation_env("A", physics="kinematic", info_keys=())
    check_env_specs(bare)
    assert "info" not in bare.reset()


def test_the_specs_hold_in_generated_worlds_with_history_and_noise() -> None:
    noise = {"slip": 0.1}
    task = {
        "progress": "shortest_path",
        "max_steps": 20,
        "history": 2,
        "noise": noise,
        "latency": 0.1,
    }
    env = make_navigation_env("mixed", num_envs=3, physics="kinematic", seed=0, **task)
    check_env_specs(env)
    assert env.env.config.noise == RobotNoise(**noise)
    rollout = env.rollout(30, break_when_any_done=False)
    assert rollout["observation"].shape == (3, 30, 24 + 2 * 18)
    assert rollout["observation"].isfinite().all()
    assert rollout["next", "done"].sum() >= 6
    assert len({world.name for world in env.env.worlds}) == 3


def test_one_robot_has_the_episodes_of_the_environment_for_one() -> None:
    env = make_navigation_env("D", physics="kinematic", seed=5)
    single = NavigationEnv(world="D", physics="kinematic")
    for seed in (5, None):
        seen, _ = single.reset(seed=seed)
        np.testing.assert_array_equal(env.reset()["observation"].numpy(), seen)


def test_a_task_can_come_with_its_world() -> None:
    env = make_navigation_env("bars", num_envs=2, physics="kinematic", seed=0)
    pair = evaluation_pairs("test", 1, seed=0)[0]
    env.set_task(*pair, index=1, world="test")
    with pytest.raises(ValueError, match="world must be given"):
        env.set_task(*pair, index=0)
    env.reset(TensorDict({"_reset": torch.tensor([[True], [True]])}, [2]))
    assert [world.name == "test" for world in env.env.worlds] == [False, True]
    assert env.env.tasks[1] == pair


def test_batches_of_robots_can_be_collected_and_flattened() -> None:
    def make() -> NavigationTorchEnv:
        return NavigationTorchEnv(num_envs=2, world="A", physics="kinematic", max_steps=8)

    collector = Collector(make, None, frames_per_batch=40, total_frames=80)
    shapes = [tuple(batch.shape) for batch in collector]
    collector.shutdown()
    assert shapes == [(2, 20), (2, 20)]
    serial = SerialEnv(2, make)
    assert serial.rollout(10, break_when_any_done=False).shape == (2, 2, 10)
    serial.close()
