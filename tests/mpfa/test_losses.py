"""Distances of value and target: PAL against its plain form, and against what it stands for."""

import math

import pytest
import torch

from tests.mpfa.transitions import seeded
from torchrl_mpfa.losses import distance, pal_distance, smoothing_noise

ALPHA = 0.4


def pal_by_hand(errors, alpha):
    scale = sum(max(abs(e), 1.0) ** alpha for e in errors) / len(errors)
    return [
        (0.5 * e * e if abs(e) <= 1.0 else abs(e) ** (1.0 + alpha) / (1.0 + alpha)) / scale
        for e in errors
    ]


def test_pal_is_its_formula():
    errors = [0.0, 0.3, -0.9, 1.0, -2.5, 7.0]
    found = pal_distance(torch.tensor(errors, dtype=torch.double), alpha=ALPHA)
    assert found.tolist() == pytest.approx(pal_by_hand(errors, ALPHA))


def test_uniform_sampling_with_pal_has_the_gradient_of_lap():
    """Theorem of Fujimoto et al. 2020: sum_i p_i grad Huber(e_i) = mean_i grad PAL(e_i)."""
    error = (torch.randn(50, generator=seeded(0), dtype=torch.double) * 3).requires_grad_(True)
    (of_pal,) = torch.autograd.grad(pal_distance(error, alpha=ALPHA).mean(), error)
    priority = error.detach().abs().clamp_min(1.0).pow(ALPHA)
    share = priority / priority.sum()
    huber = torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none")
    (of_lap,) = torch.autograd.grad((share * huber).sum(), error)
    torch.testing.assert_close(of_pal, of_lap)


def test_pal_has_a_finite_slope_where_there_is_no_error():
    error = torch.zeros(3, requires_grad=True)
    pal_distance(error).sum().backward()
    assert error.grad.tolist() == [0.0, 0.0, 0.0]


def test_of_two_critics_the_larger_error_normalizes_both():
    errors = torch.tensor([[0.5, 4.0], [2.0, 0.1]])
    scale = (2.0**ALPHA + 4.0**ALPHA) / 2
    found = pal_distance(errors, alpha=ALPHA)
    assert found[0, 0].item() == pytest.approx(0.125 / scale)
    assert found[1, 0].item() == pytest.approx(2.0**1.4 / 1.4 / scale)


@pytest.mark.parametrize(
    ("name", "expected"), [("l2", 9.0), ("l1", 3.0), ("smooth_l1", 2.5), ("pal", 3.0 / 1.4)]
)
def test_each_distance_has_its_value(name, expected):
    found = distance(torch.zeros(1), torch.full((1,), 3.0), name)
    assert math.isclose(found.item(), expected, rel_tol=1e-6)


@pytest.mark.parametrize("name", ["smooth_l1", "pal"])
def test_bend_with_scaled_rewards_is_at_the_same_error(name):
    error = torch.randn(20, generator=seeded(1)) * 3
    plain = distance(torch.zeros(20), error, name)
    scaled = distance(torch.zeros(20), 0.1 * error, name, unit=0.1)
    torch.testing.assert_close(scaled, 0.01 * plain)


def test_noise_of_targets_has_its_deviation_and_reaches_both_limits():
    noise = smoothing_noise(torch.zeros(10_000, 2), deviation=0.2, limit=0.5)
    assert (noise.amin().item(), noise.amax().item()) == (-0.5, 0.5)
    assert noise.std().item() == pytest.approx(0.2, rel=0.05)
