"""Rewards of one sign: Eq. (17) degenerates, one warning says so, and one argument cures it."""

import warnings

import pytest
import torch

from tests.mpfa.transitions import make_buffer, make_transitions, seeded, set_signals, train_rounds
from torchrl_mpfa import (
    EntropyFusion,
    FixedFusion,
    MPFASampler,
    PositiveBoost,
    ScaledFusion,
    SignalTensorStorage,
)
from torchrl_mpfa.methods import make_replay

pytestmark = pytest.mark.usefixtures("path")


def pendulum(count=1200, *, seed=0):
    """Rewards of Pendulum: a cost, hence negative."""
    return make_transitions(count, rewards=-torch.rand(count, generator=seeded(seed)) * 16)


@pytest.mark.parametrize(("sign", "share"), [(1.0, "none"), (-1.0, "all")])
@pytest.mark.parametrize("options", [{}, {"fusion": ScaledFusion(EntropyFusion())}], ids=str)
def test_one_warning_names_the_cure(sign, share, options):
    buffer, rows = make_buffer(2000, 32, entropy_refresh=0, **options), pendulum()
    rows["next", "reward"] *= sign
    buffer.extend(rows)
    cure = rf"{share} of the 1200 rewards .*to 'mean', with which all weights are equal"
    with pytest.warns(UserWarning, match=cure) as seen:
        train_rounds(buffer, 5)
    assert len(seen) == 1
    assert buffer.sampler.weights["td_error"] == buffer.sampler.weights["action_gradient"] == 0.0


def test_rewards_up_to_the_level_are_on_one_side_of_it():
    buffer, rows = make_buffer(2000, 32, entropy_refresh=0, positive_above=-1.0), pendulum()
    rows["next", "reward"][::2] = -1.0
    rows["next", "reward"].clamp_(max=-1.0)
    buffer.extend(rows)
    with pytest.warns(UserWarning, match="none of the 1200 rewards in the buffer are above -1.0"):
        train_rounds(buffer, 5)


@pytest.mark.filterwarnings("ignore:positive_above='mean'")
@pytest.mark.parametrize("level", ["mean", -8.0])
def test_the_cure_gives_every_signal_its_weight(level):
    buffer = make_buffer(2000, 64, positive_above=level, entropy_refresh=0)
    buffer.extend(pendulum())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train_rounds(buffer, 3)
    assert min(buffer.sampler.weights.values()) > 0.3


@pytest.mark.parametrize(
    "make",
    [
        lambda: MPFASampler(8, fusion=ScaledFusion(EntropyFusion()), positive_above="mean"),
        lambda: MPFASampler(8, positive_above="mean"),
        lambda: make_replay("mpfa_per", capacity=8, positive_above="mean"),
    ],
)
def test_mean_as_level_causes_a_warning_of_equal_weights(make):
    with pytest.warns(UserWarning, match="equal weights for any data") as told:
        make()
    assert len(told) == 1


def test_the_mean_of_the_buffer_reaches_the_boost():
    parts = {
        "adjustments": [PositiveBoost(boost=2.0, bound="none")],
        "fusion": FixedFusion({"td_error": 1.0}),
    }
    buffer = make_buffer(4, positive_above="mean", eps=0.0, **parts)
    buffer.extend(make_transitions(4, rewards=[-1.0, -3.0, -5.0, -7.0]))
    set_signals(buffer, td_error=torch.ones(4), action_gradient=torch.ones(4))
    assert buffer.sampler.priorities().tolist() == [2.0, 2.0, 1.0, 1.0]


def test_the_level_of_a_method_is_that_of_its_sampler_also_after_a_change_of_capacity():
    sampler = make_replay("mpfa_per", capacity=8, positive_above=-2).buffer.sampler
    assert (sampler.positive_above, sampler.table.positive_above) == (-2, -2)
    buffer = make_buffer(None, storage=SignalTensorStorage(16), positive_above=-3.0)
    assert (buffer.sampler.max_size, buffer.sampler.table.positive_above) == (16, -3.0)


@pytest.mark.filterwarnings("ignore:positive_above='mean'")
def test_the_mean_is_that_of_the_buffer_and_saved():
    first, second = (make_buffer(64, 8, positive_above="mean") for _ in range(2))
    first.extend(make_transitions(64, rewards=torch.arange(-64.0, 0.0)))
    train_rounds(first, 1)
    assert first.sampler.state_dict()["_mean_reward"] == -32.5
    second.load_state_dict(first.state_dict())
    assert second.sampler.state_dict()["_mean_reward"] == -32.5
    assert train_rounds(first, 3).equal(train_rounds(second, 3))


@pytest.mark.parametrize("rewards", [torch.rand(99), torch.rand(1500) - 0.5])
def test_few_rewards_or_rewards_of_both_signs_are_no_reason_for_a_warning(rewards):
    buffer = make_buffer(2000, 32, entropy_refresh=0)
    buffer.extend(make_transitions(len(rewards), rewards=rewards))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train_rounds(buffer, 2)


def test_boost_alone_waits_for_rewards_above_a_level_and_not_for_positive_ones():
    def train(level):
        fusion = FixedFusion({"td_error": 1.0})
        buffer = make_buffer(2000, 32, fusion=fusion, positive_above=level)
        buffer.extend(pendulum())
        train_rounds(buffer, 1)

    train(1.0)
    with pytest.warns(UserWarning, match="none of the 1200 rewards in the buffer are above 0"):
        train(0.0)


def test_the_warning_comes_once_whatever_the_number_of_rewards():
    buffer = make_buffer(20_000, 32)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for turn in range(20):
            buffer.extend(make_transitions(200, rewards=-torch.rand(200) - 0.1, seed=turn))
            train_rounds(buffer, 1)
    assert sum("rewards in the buffer are" in str(warning.message) for warning in caught) == 1
