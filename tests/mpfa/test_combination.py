"""Sum, product and mixture of signals: priorities and frequencies against plain loops."""

import math

import pytest
import torch
from tensordict import TensorDict

from tests.methods.replays import assert_shares, seeded, set_signals
from tests.mpfa.test_updates import make_learner, make_rows
from tests.mpfa.transitions import restore, same
from torchrl_mpfa import (
    MixtureSampler,
    PositiveBoost,
    SignalReplayBuffer,
    SignalSampler,
    SignalTensorStorage,
    run_updates,
)
from torchrl_mpfa.fusion import FixedFusion, fuse_product
from torchrl_mpfa.methods import loss_options, make_replay
from torchrl_mpfa.testing import check_sampler

COUNT, SAMPLES, ALPHA, EPS = 12, 60_000, 0.6, 0.05
SIGNALS = ["reward", "td_error"]


def make_plus(combination, rewards, errors, *, capacity=COUNT, **settings):
    """A buffer whose transitions have these rewards and TD errors."""
    given = {"boost": False, "positive_above": 0.0, "signals": SIGNALS, **settings}
    replay = make_replay(
        "mpfa_plus",
        capacity=capacity,
        batch_size=SAMPLES,
        generator=seeded(0),
        combination=combination,
        **given,
    )
    replay.buffer.extend(TensorDict({"next": {"reward": rewards.unsqueeze(1)}}, [len(rewards)]))
    for _ in range(2):  # The second time the means of the errors are known.
        set_signals(replay.buffer, td_error=errors)
    return replay.buffer


def random_signals(count=COUNT):
    rewards = torch.randn(count, generator=seeded(1)) * 5
    return rewards, torch.rand(count, generator=seeded(2))


def shares_of(leaves):
    return torch.tensor([leaf / sum(leaves) for leaf in leaves], dtype=torch.double)


def mixture_by_hand(rewards, errors, weights=(0.5, 0.5)):
    """Probabilities of a mixture, signal by signal."""
    found = [0.0] * len(errors)
    for weight, signal in zip(weights, (map(abs, rewards), errors), strict=True):
        leaves = [(value + EPS) ** ALPHA for value in signal]
        for slot, leaf in enumerate(leaves):
            found[slot] += weight * leaf / sum(leaves)
    return found


def test_in_a_sum_each_signal_is_divided_by_its_mean():
    rewards, errors = random_signals()
    buffer = make_plus("sum", rewards, errors, alpha=1.0)
    sizes = rewards.abs().tolist()
    means = sum(sizes) / COUNT, sum(errors.tolist()) / COUNT
    expected = [
        size / means[0] + error / means[1] + EPS
        for size, error in zip(sizes, errors.tolist(), strict=True)
    ]
    # What was fused at the last update was weighed when most was not yet known.
    found = SignalSampler(
        COUNT, 1.0, 0.4, EPS, signals=SIGNALS, entropy_refresh=0, fusion=buffer.sampler.fusion
    )
    table = buffer._storage.signal_table
    found.update_signals(torch.arange(COUNT), {"td_error": errors}, storage=buffer._storage)
    assert table.size == COUNT
    assert found.priorities().tolist() == pytest.approx(expected, rel=1e-5)


def test_a_product_is_the_geometric_mean_and_its_frequencies_follow():
    rewards, errors = random_signals()
    buffer = make_plus("product", rewards, errors)
    expected = [
        math.sqrt((abs(reward) + EPS) * (error + EPS))
        for reward, error in zip(rewards.tolist(), errors.tolist(), strict=True)
    ]
    assert buffer.sampler.priorities().tolist() == pytest.approx(expected, rel=1e-5)
    shares = shares_of([value**ALPHA for value in expected])
    assert_shares(buffer.sample()["index"], shares, samples=SAMPLES)


def test_a_weight_is_an_exponent_and_none_leaves_a_signal_out():
    signals = torch.tensor([[2.0, 3.0], [0.0, 5.0]], dtype=torch.double)
    found = fuse_product(signals, torch.tensor([3.0, 1.0]).double(), eps=0.0)
    assert found.tolist() == pytest.approx([2.0**0.75 * 3.0**0.25, 0.0])
    alone = fuse_product(signals, torch.tensor([0.0, 2.0]).double(), eps=0.0)
    assert alone.tolist() == pytest.approx([3.0, 5.0])


def test_a_mixture_samples_by_each_signal_in_its_turn():
    rewards, errors = random_signals()
    buffer = make_plus("mixture", rewards, errors)
    expected = mixture_by_hand(rewards.tolist(), errors.tolist())
    batch = buffer.sample()
    assert_shares(batch["index"], torch.tensor(expected, dtype=torch.double), samples=SAMPLES)
    leaves = [[(v + EPS) ** ALPHA for v in s] for s in (rewards.abs().tolist(), errors.tolist())]
    bound = sum(0.5 * min(each) / sum(each) for each in leaves)
    weights = [(expected[slot] / bound) ** -buffer.sampler.beta for slot in batch["index"][:50]]
    assert batch["priority_weight"][:50].tolist() == pytest.approx(weights, rel=1e-4)
    assert 0 < batch["priority_weight"].max() <= 1.0


def test_the_shares_of_a_mixture_are_the_weights_and_alpha_may_change():
    rewards, errors = random_signals()
    sampler = MixtureSampler(
        COUNT, 1.0, 0.4, EPS, signals=SIGNALS, fusion=FixedFusion({"reward": 3, "td_error": 1})
    )
    buffer = make_plus("mixture", rewards, errors)
    buffer._sampler = sampler
    buffer._init()
    sampler.extend(torch.arange(COUNT))
    sampler.mark_update(torch.arange(COUNT))
    set_signals(buffer, td_error=errors)
    sampler.alpha = ALPHA
    expected = torch.tensor(
        mixture_by_hand(rewards.tolist(), errors.tolist(), (0.75, 0.25)), dtype=torch.double
    )
    assert_shares(buffer.sample()["index"], expected, samples=SAMPLES)


def test_what_adjustments_do_to_the_sum_they_do_to_each_signal():
    rewards, errors = random_signals()
    buffer = make_plus("mixture", rewards, errors, boost=True, boost_factor=4.0)
    expected = [0.0] * COUNT
    for signal in (rewards.abs().tolist(), errors.tolist()):
        leaves = [
            ((value + EPS) * (4.0 if reward > 0 else 1.0)) ** ALPHA
            for value, reward in zip(signal, rewards.tolist(), strict=True)
        ]
        expected = [e + 0.5 * leaf / sum(leaves) for e, leaf in zip(expected, leaves, strict=True)]
    shares = torch.tensor(expected, dtype=torch.double)
    assert_shares(buffer.sample()["index"], shares, samples=SAMPLES)


def test_a_fresh_transition_is_the_first_by_every_signal():
    rewards, errors = random_signals()
    buffer = make_plus("mixture", rewards, errors, capacity=COUNT + 1)
    buffer.extend(TensorDict({"next": {"reward": torch.zeros(1, 1)}}, [1]))
    for part, signal in zip(("reward", "td_error"), (rewards.abs(), errors), strict=True):
        priorities = buffer.sampler._parts[part].priorities()
        assert float(priorities[COUNT]) == pytest.approx(float(signal.max()) + EPS)


def frequencies_with(combination, factor):
    """Frequencies of transitions whose rewards have this scale."""
    rewards, errors = random_signals()
    buffer = make_plus(combination, (rewards.abs() + 1) * factor, errors + 1, eps=1e-3)
    return torch.bincount(buffer.sample()["index"], minlength=COUNT) / SAMPLES


@pytest.mark.parametrize("combination", ["sum", "product", "mixture"])
def test_the_scale_of_the_rewards_does_not_matter(combination):
    small, large = (frequencies_with(combination, factor) for factor in (1.0, 100.0))
    assert (small - large).abs().max() < 0.004


def test_a_product_wants_both_signals_and_a_sum_and_a_mixture_either():
    """Transitions 0: both signals; 1: the reward alone; 2: the error alone; the rest: none."""
    rewards, errors = torch.full((100,), 0.1), torch.full((100,), 0.1)
    rewards[[0, 1]] = 10.0
    errors[[0, 2]] = 10.0
    found = {}
    for combination in ("sum", "product", "mixture"):
        buffer = make_plus(combination, rewards, errors, capacity=100, alpha=1.0)
        shares = torch.bincount(buffer.sample()["index"], minlength=100) / SAMPLES
        found[combination] = float(shares[0] / shares[[1, 2]].mean())
    assert found["product"] > 5
    assert 1.5 < found["sum"] < 2.5
    assert 1.5 < found["mixture"] < 2.5


def test_goals_alone_are_raised_and_steps_towards_them_are_not():
    rewards = torch.tensor([10.0] * 5 + [0.4] * 45 + [-0.4] * 50)
    replay = make_replay("mpfa_plus", boost=True, capacity=100, batch_size=8)
    replay.buffer.extend(TensorDict({"next": {"reward": rewards.unsqueeze(1)}}, [100]))
    for _ in range(3):
        set_signals(replay.buffer, td_error=torch.ones(100), action_gradient=torch.ones(100))
    found = replay.buffer.sampler.priorities()
    assert found[5:50].unique().tolist() == found[50:].unique().tolist()  # Steps are alike.
    plain = make_replay("mpfa_plus", capacity=100, batch_size=8)
    assert plain.buffer.sampler.adjustments == ()
    assert float(found[0]) == pytest.approx(
        3 * float(10 / rewards.abs().mean() + 2 + EPS), rel=0.01
    )


@pytest.mark.parametrize("combination", ["product", "mixture"])
def test_updates_of_many_robots_go_through_every_combination(combination):
    learner = make_learner(**loss_options("mpfa_plus"))
    replay = make_replay("mpfa_plus", capacity=200, batch_size=16, combination=combination)
    replay.buffer.extend(make_rows(200))
    for _ in range(3):
        log, batch = run_updates(replay.buffer, learner, replay.select, updates=3)
    assert learner.updates == 9
    assert log["loss_value"].isfinite()
    assert 0 < batch["priority_weight"].min() <= batch["priority_weight"].max() <= 1
    assert replay.buffer.stats()["weight/reward"] == 1.0  # Not divided by its mean.


def test_a_product_passes_the_checks_and_a_mixture_is_saved_and_loaded(
    tmp_path,
):
    check_sampler(lambda: SignalSampler(64, 0.6, 0.4, EPS, combination="product", signals=SIGNALS))
    rewards, errors = random_signals()
    first = make_plus("mixture", rewards, errors)
    for folder in (None, tmp_path / "buffer"):
        second = make_plus("mixture", rewards * 2, errors.flip(0))
        restore(second, first, folder)
        assert same(first.sampler.state_dict(), second.sampler.state_dict())
        assert first.sample()["index"].equal(second.sample()["index"])


def test_a_saved_mixture_without_a_tree_for_each_signal_is_rejected():
    first, second = (MixtureSampler(4, 0.6, 0.4, EPS, signals=SIGNALS) for _ in range(2))
    for value in (None, {"reward": {}}, {name: {} for name in SIGNALS}):
        before = second.state_dict()
        with pytest.raises(
            ValueError, match=r"'_parts' of the saved sampler must be a tree|format"
        ):
            second.load_state_dict({**first.state_dict(), "_parts": value})
        assert same(before, second.state_dict())


def test_a_boost_is_a_factor_of_each_signal_with_its_eps():
    sampler = MixtureSampler(
        2, 1.0, 1.0, 0.5, signals=SIGNALS, adjustments=[PositiveBoost(boost=3.0, bound="none")]
    )
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(2, signals=SIGNALS), sampler=sampler, batch_size=2
    )
    buffer.extend(TensorDict({"next": {"reward": torch.tensor([[1.0], [-2.0]])}}, [2]))
    set_signals(buffer, td_error=torch.tensor([0.25, 4.0]))
    leaves = [[(1.0 + 0.5) * 3.0, 2.0 + 0.5], [(0.25 + 0.5) * 3.0, 4.0 + 0.5]]
    shares = [[leaf / sum(each) for leaf in each] for each in leaves]
    expected = [(first + second) / 2 for first, second in zip(*shares, strict=True)]
    weights = sampler.batch_weights(2)
    assert float(weights[0] / weights[1]) == pytest.approx(expected[1] / expected[0])
