from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial

import pytest
import torch
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

from mpfa_envs import NavigationTorchEnv, RobotNoise, make_navigation_env
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
