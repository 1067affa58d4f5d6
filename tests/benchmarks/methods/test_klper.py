"""KLPER: the divergence against a plain computation, and the batch that is chosen."""

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import MultivariateNormal, kl_divergence

from benchmarks.paper.methods.klper import KLPERSelection, gaussian_divergence
from tests.mpfa.transitions import seeded
from torchrl_mpfa import make_actor


@pytest.mark.parametrize("shape", [(8,), (8, 1), (8, 3)])
def test_actions_of_another_form_than_the_policys_are_rejected_by_name(shape):
    select = KLPERSelection(make_actor(24, 2), batches=2, sigma=0.2)
    seen = TensorDict({"observation": torch.rand(8, 24), "action": torch.zeros(shape)}, [8])
    with pytest.raises(ValueError, match=r"'action' must have the shape"):
        select(seen)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_deviations_wider_than_the_noise_have_the_divergence_of_two_gaussians(size):
    deviation = torch.randn(3, 64, size, generator=seeded(size)).double() * 0.3 + 0.1
    found = gaussian_divergence(deviation, variance=0.01)
    for batch, value in zip(deviation, found, strict=True):
        mean = batch.mean(0)
        covariance = (batch - mean).T @ (batch - mean) / len(batch)
        reference = MultivariateNormal(torch.zeros(size).double(), 0.01 * torch.eye(size).double())
        expected = kl_divergence(MultivariateNormal(mean, covariance), reference)
        torch.testing.assert_close(value, expected)


def test_deviations_narrower_than_the_noise_are_no_further_from_the_policy():
    deviation = torch.randn(64, 2, generator=seeded(1)).double() * 0.3
    mean = deviation.mean(0)
    found = gaussian_divergence(deviation, variance=0.5)
    torch.testing.assert_close(found, 0.5 * mean.square().sum() / 0.5)
    assert gaussian_divergence(deviation - mean, variance=0.5) < 1e-12


class Elsewhere:
    """A policy on a device that not every machine has; only what is there already does it read."""

    in_keys = ("observation",)

    def parameters(self):
        return iter([torch.empty(1, device="meta")])

    def __call__(self, read):
        assert read.device == torch.device("meta")
        return TensorDict({"action": torch.zeros(len(read), 2)}, [len(read)])


def test_policy_may_be_on_another_device_than_the_batch():
    action = torch.tensor([0.0, 0.5]).repeat_interleave(4).unsqueeze(1).expand(8, 2)
    batch = TensorDict({"observation": torch.rand(8, 3), "action": action}, [8])
    chosen = KLPERSelection(Elsewhere(), batches=2, sigma=0.2)(batch)
    assert torch.equal(chosen["action"], torch.zeros(4, 2))


def sampled(policy, shifts, *, count=64, sigma=0.2):
    """Batches whose actions are the policy's with noise, each shifted by so much."""
    observation = torch.randn(len(shifts) * count, 6, generator=seeded(0))
    action = policy(TensorDict({"observation": observation}, [len(observation)]))["action"]
    noise = torch.randn(action.shape, generator=seeded(1)) * sigma
    shift = torch.tensor(shifts).repeat_interleave(count).unsqueeze(-1)
    number = torch.arange(len(observation))
    return TensorDict(
        {"observation": observation, "action": action.detach() + noise + shift, "number": number},
        [len(observation)],
    )


@pytest.mark.parametrize("best", [0, 1, 2])
def test_batch_of_the_current_policy_is_chosen(best):
    policy = make_actor(6, 2, width=16)
    shifts = [0.7, 0.7, 0.7]
    shifts[best] = 0.0
    batch = KLPERSelection(policy, sigma=0.2)(sampled(policy, shifts))
    assert batch["number"].tolist() == list(range(64 * best, 64 * (best + 1)))


def test_noise_of_the_current_episode_is_read_at_each_batch():
    policy = make_actor(6, 2, width=16)
    asked = iter([0.2, 0.7])
    select = KLPERSelection(policy, batches=2, sigma=lambda: next(asked))
    wide = sampled(policy, [0.0, 0.0], sigma=0.7)
    shifted = sampled(policy, [0.4, 0.4], sigma=0.1)
    both = torch.cat([shifted[:64], wide[64:]])
    assert select(both)["number"][0] == 0
    assert select(both)["number"][0] == 64


def test_rows_that_make_no_equal_batches_are_rejected():
    policy = make_actor(6, 2, width=16)
    with pytest.raises(ValueError, match="64 transitions cannot make 3 equal batches"):
        KLPERSelection(policy, sigma=0.2)(sampled(policy, [0.0]))
