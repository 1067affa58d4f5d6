"""Replay with priorities in Stable-Baselines3: signals, weights, and what is sampled more often."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_replay import PriorityReplay, PriorityTD3, main, make_model

pytestmark = pytest.mark.filterwarnings("ignore")
ALGORITHMS = ["td3", "ddpg"]


def model_of(algorithm: str, replay: str, **options: object) -> PriorityTD3:
    """A model that has acted 200 times, and learned from the last 100 actions."""
    chosen = {"batch_size": 64, "learning_starts": 100, "gradient_steps": 2, "seed": 0, **options}
    model = make_model(algorithm, "Pendulum-v1", replay, **chosen)
    model.target_policy_noise = model.target_noise_clip = 0.0
    model.learn(200)
    return model


def errors_of(model: PriorityTD3, batch: TensorDictBase) -> tuple[list[Tensor], Tensor]:
    """Q minus target of each critic, ``[B]``, and the slope of the first critic, ``[B]``."""
    observations, actions = batch["observation"], batch["action"].clone().requires_grad_()
    after, reward, ended = (
        batch["next", key].float() for key in ("observation", "reward", "terminated")
    )
    with torch.no_grad():
        policy = model.actor_target(after).clamp(-1, 1)
        value = torch.cat(model.critic_target(after, policy), dim=1).amin(1, keepdim=True)
        target = reward + (1 - ended) * model.gamma * value
    values = model.critic(observations, actions)
    (slope,) = torch.autograd.grad(values[0].sum(), actions, retain_graph=True)
    return [(value - target).squeeze(1) for value in values], slope.norm(dim=1)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("replay", ["per", "mpfa_per"])
def test_update_has_the_gradient_of_eq_11_and_writes_its_signals(
    algorithm: str, replay: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = model_of(algorithm, replay, policy_kwargs={"net_arch": [8]})
    # Without its step, and without the actor's loss, whose gradient the critic would keep.
    model.policy_delay, model._n_updates = 2, 0
    monkeypatch.setattr(model.critic.optimizer, "step", lambda: None)
    buffer, learned = model.replay_buffer, []
    update = buffer.update
    monkeypatch.setattr(buffer, "update", lambda: (learned.append(buffer.batch), update()))
    model.train(1, 64)
    (batch,) = learned
    found = [parameter.grad.clone() for parameter in model.critic.parameters()]
    errors, slope = errors_of(model, batch)
    weight = batch["priority_weight"]
    assert weight.max() > 1.5 * weight.min()
    loss = sum((weight * error.square()).mean() for error in errors)
    for gradient, want in zip(
        found, torch.autograd.grad(loss, [*model.critic.parameters()]), strict=True
    ):
        torch.testing.assert_close(gradient, want, rtol=1e-4, atol=1e-5)
    largest = torch.stack(errors).detach().abs().amax(0)
    torch.testing.assert_close(batch["signals", "td_error"], largest, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(batch["signals", "action_gradient"], slope, rtol=1e-4, atol=1e-5)
    stored = buffer.replay.distributions()["td_error"][batch["index"]]
    torch.testing.assert_close(stored.float(), largest, rtol=1e-4, atol=1e-5)


def favor(model: PriorityTD3) -> float:
    """How much more often the third with the largest TD errors is sampled than the smallest."""
    buffer = model.replay_buffer
    errors, _ = errors_of(model, buffer.replay[:])
    order = torch.stack(errors).abs().amax(0).argsort()
    counts = torch.zeros(len(order))
    for _ in range(300):
        index = buffer.replay.sample(64)["index"]
        counts += torch.bincount(index, minlength=len(order))
    third = len(order) // 3
    return float(counts[order[-third:]].mean() / counts[order[:third]].mean())


def test_larger_td_errors_are_sampled_more_often() -> None:
    assert favor(model_of("td3", "per")) > 1.4
    assert favor(model_of("td3", "uniform")) == pytest.approx(1.0, abs=0.1)


def test_several_environments_with_normalized_observations_write_their_transitions() -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=3))
    model = make_model("td3", env, "mpfa_per", buffer_size=300, learning_starts=90, seed=0)
    model.learn(900)
    rows = model.replay_buffer.replay[:]
    assert len(rows) == model.replay_buffer.size() == 300
    # Pendulum ends by its time limit alone, which is no end.
    assert not rows["next", "terminated"].any()
    # Kept as they were, and normalized at each sample.
    norm = rows["observation"][:, :2].norm(dim=1)
    torch.testing.assert_close(norm, torch.ones(300), rtol=1e-4, atol=1e-4)
    given = model.replay_buffer.sample(8, env)
    batch = model.replay_buffer.batch
    normal = env.normalize_obs(batch["observation"].numpy())
    np.testing.assert_array_equal(given.observations, normal)
    rewards = env.normalize_reward(batch["next", "reward"].numpy())
    np.testing.assert_allclose(given.rewards, rewards, rtol=1e-6)
    late = [True, False, True]
    zeros = np.zeros((3, 3), np.float32)
    infos = [{"TimeLimit.truncated": flag} for flag in late]
    model.replay_buffer.add(zeros, zeros, zeros[:, :1], zeros[:, 0], np.ones(3), infos)
    assert model.replay_buffer.replay[:]["next", "terminated"].sum() == 1


def test_importance_exponent_rises_to_one_at_the_end() -> None:
    model = model_of("td3", "per")
    assert model.replay_buffer.replay.sampler.beta == pytest.approx(1.0)


def test_saved_model_learns_on_with_priorities(tmp_path: Path) -> None:
    model = model_of("td3", "per")
    model.save(tmp_path / "model.zip")
    model.replay_buffer.replay.dumps(tmp_path / "replay")
    resumed = PriorityTD3.load(tmp_path / "model.zip", env=model.get_env())
    resumed.replay_buffer.replay.loads(tmp_path / "replay")
    before = resumed.replay_buffer.replay.distributions()["priority"]
    assert before.equal(model.replay_buffer.replay.distributions()["priority"])
    resumed.learn(20, reset_num_timesteps=False)
    after = resumed.replay_buffer.replay.distributions()["priority"]
    assert len(after) == 220 and (after[:200] != before).sum() > 20


def test_a_reward_counts_as_positive_above_the_mean_where_all_have_one_sign() -> None:
    assert (
        make_model("td3", "Pendulum-v1", "mpfa_per").replay_buffer.method.positive_above == "mean"
    )


def test_another_method_and_memory_of_one_array_are_rejected() -> None:
    with pytest.raises(ValueError, match=r"method must be one of .*, got 'lap'"):
        make_model("td3", "Pendulum-v1", "lap")
    with pytest.raises(ValueError, match="optimize_memory_usage must be False, got True"):
        make_model("td3", "Pendulum-v1", "per", optimize_memory_usage=True)


def test_an_algorithm_that_writes_no_priorities_is_an_error_at_its_second_update() -> None:
    def model(replay: str) -> SAC:
        given = {"replay_buffer_class": PriorityReplay, "replay_buffer_kwargs": {"method": replay}}
        given |= {"learning_starts": 100, "policy_kwargs": {"net_arch": [8]}, "device": "cpu"}
        return SAC("MlpPolicy", "Pendulum-v1", **given)

    with pytest.raises(RuntimeError, match="must be ReplayBuffer for"):
        model("per").learn(110)
    model("uniform").learn(110)


def test_reset_forgets_all_transitions() -> None:
    model = model_of("td3", "per")
    model.replay_buffer.reset()
    assert model.replay_buffer.size() == 0
    model.learn(300)
    assert model.replay_buffer.size() == 300


def test_a_buffer_without_room_is_rejected() -> None:
    with pytest.raises(ValueError, match="buffer_size must be at least n_envs = 1, got 0"):
        make_model("td3", "Pendulum-v1", "per", buffer_size=0)


def test_so_few_actions_that_nothing_is_learned_are_rejected(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        main(["td3", "--actions", "100"])
    assert "--actions must be more than 100, got 100" in capsys.readouterr().err
