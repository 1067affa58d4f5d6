"""Targets of one step and of several: those of TorchRL's own losses, and of loops by hand."""

import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.transforms import MultiStepTransform

from tests.mpfa.learning import (
    BOUNDS,
    KINDS,
    differentiate,
    make_apart,
    make_batch,
    make_learner,
    make_torchrls,
)
from tests.mpfa.transitions import same

# TorchRL warns at every loss of its own whose target networks nothing moves.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

GAMMA, STEPS = 0.5, 3


def of_several_steps(count=14, **options):
    """What a buffer holds after TorchRL's transform: ends in the middle, and a time limit."""
    transform = MultiStepTransform(n_steps=STEPS, gamma=GAMMA, **options)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(count), transform=transform, batch_size=1
    )
    trajectory = make_batch(count)
    ends = trajectory["next"]
    for key, row in (("terminated", 5), ("truncated", 9)):
        ends[key] = torch.zeros(count, 1, dtype=torch.bool)
        ends[key][row] = True
    ends["done"] = ends["terminated"] | ends["truncated"]
    buffer.extend(trajectory)
    return buffer[:]


def targets_of(learner, batch, seed=3):
    """Targets by these random numbers: TD3 and SAC ask random actions."""
    torch.manual_seed(seed)
    return learner.targets_of(batch)


@pytest.mark.parametrize("column", [False, True], ids=["[B]", "[B, 1]"])
@pytest.mark.parametrize("options", [{}, {"done_keys": ["done"]}], ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_targets_of_several_steps_are_those_of_torchrls_loss(kind, options, column):
    batch = of_several_steps(**options)
    assert set(batch["steps_to_next_obs"].flatten().tolist()) == {1, 2, 3}
    assert bool(batch["next", "terminated"].any())
    if column:
        batch["steps_to_next_obs"] = batch["steps_to_next_obs"].unsqueeze(-1)
    learner = make_apart(kind, gamma=GAMMA)
    loss = make_torchrls(kind, learner)
    torch.manual_seed(3)
    theirs = loss(batch.clone())
    log = differentiate(learner, batch.clone(), seed=3)
    # Where TorchRL does not tell targets, the critics' loss shows them.
    if kind == "sac":
        torch.testing.assert_close(log["loss_value"], theirs["loss_qvalue"].detach())
    else:
        torch.testing.assert_close(log["target_value"], theirs["target_value"])
    assert log["target_value"].equal(targets_of(learner, batch))
    one_step = targets_of(learner, batch.exclude("steps_to_next_obs"))
    assert not torch.allclose(one_step, log["target_value"])


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float32], ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_ends_that_are_numbers_count_as_booleans(kind, dtype):
    learner, batch = make_apart(kind), make_batch(12)
    numbers = batch.clone()
    for key in ("done", "terminated"):
        numbers["next", key] = numbers["next", key].to(dtype)
    torch.testing.assert_close(targets_of(learner, numbers), targets_of(learner, batch))
    assert numbers["next", "terminated"].dtype is dtype


def test_target_of_ddpg_is_at_an_action_with_noise_within_the_bounds():
    noisy = {"critics": 1, "policy_noise": 0.8, "noise_clip": 0.6, "bounds": (-0.5, 0.5)}
    learner, batch = make_apart("ddpg", **noisy), make_batch()
    found, after = targets_of(learner, batch), batch["next"]
    with torch.no_grad():
        action = learner.targets["actor"].outputs(after)["action"]
        torch.manual_seed(3)
        noise = (torch.randn_like(action) * 0.8).clamp(-0.6, 0.6)
        assert bool((noise.abs() == 0.6).any())
        smoothed = (action + noise).clamp(-0.5, 0.5)
        value = learner.targets["critics"][0].module(after["observation"], smoothed)
    expected = after["reward"] + 0.9 * value * ~after["terminated"]
    torch.testing.assert_close(found, expected.squeeze(-1))


def test_without_noise_ddpg_takes_no_random_number_and_has_the_same_state():
    learner = make_learner()
    before = torch.get_rng_state()
    learner.update(make_batch())
    assert torch.get_rng_state().equal(before)
    noisy = make_learner(critics=1, policy_noise=0.1, bounds=BOUNDS)
    assert same(learner.networks.state_dict().keys(), noisy.networks.state_dict().keys())
