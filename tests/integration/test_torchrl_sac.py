"""TorchRL's own SAC on many robots: it learns by either replay, and its policy is one of ours."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torchrl.envs import ExplorationType, set_exploration_type

import torchrl_sac
from mpfa_envs import load_policy, make_navigation_env
from training.evaluating import drive

pytestmark = pytest.mark.filterwarnings("ignore:init_random_frames")


@pytest.mark.parametrize("replay", ["uniform", "mpfa"])
def test_a_trained_policy_is_one_of_this_project(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, replay: str
) -> None:
    monkeypatch.setattr(torchrl_sac, "RANDOM_ACTIONS", 48)
    monkeypatch.setattr(torchrl_sac, "BATCH_SIZE", 16)
    words = f"--replay {replay} --world rooms --robots 4 --actions 96 --output {tmp_path}"
    policy = load_policy(torchrl_sac.main(words.split()))
    assert policy.card["method"] == replay
    # As evaluate.py drives it, which has the robot from nowhere but its defaults.
    [driven] = drive(policy, ["A"], episodes=2, seed=0, physics=None, progress=False)
    assert len(driven.results) == 2


def test_the_policy_acts_as_the_actor_does() -> None:
    env = make_navigation_env(num_envs=3, memory="map", physics="kinematic", seed=0)
    network, actor, _ = torchrl_sac.make_networks(env)
    state = env.reset()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        want = actor(state)["action"]
    found = torchrl_sac.policy_of(network, card={})(state["observation"].numpy())
    torch.testing.assert_close(torch.as_tensor(found, dtype=torch.float32), want)
    env.close()
