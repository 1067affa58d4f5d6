"""Adjustments that count the buffer: when they count, what they are told, and what is saved."""

import pytest
import torch
from tensordict import TensorDict

from tests.methods.replays import make_buffer
from tests.mpfa.transitions import make_transitions, restore, seeded, set_signals
from torchrl_mpfa import Adjustment, PositiveBoost, SignalSampler
from torchrl_mpfa.methods import make_replay

pytestmark = pytest.mark.usefixtures("path")


class Census(Adjustment):
    """Counts how often it was asked, and keeps what it was told."""

    counts = True

    def __init__(self):
        self.asked, self.told, self.priority = 0, [], None

    def count(self, table, priority):
        self.asked += 1
        self.priority = priority.clone()
        return torch.tensor(float(self.asked))

    def __call__(self, priority, batch):
        self.told.append(None if batch.counted is None else int(batch.counted))
        return priority


def make_counted(capacity=64, batch_size=4, **options):
    census = Census()
    sampler = SignalSampler(
        capacity, 0.6, 0.4, 0.05, signals=["td_error"], adjustments=[census], **options
    )
    return make_buffer(sampler, capacity, batch_size), census


def train(buffer, rounds):
    for number in range(rounds):
        batch = buffer.sample()
        batch["signals", "td_error"] = torch.rand(len(batch), generator=seeded(number))
        buffer.update_tensordict_priority(batch)


def test_an_adjustment_counts_after_a_sixteenth_of_the_buffer_changed():
    buffer, census = make_counted()  # A sixteenth are four transitions, a batch.
    train(buffer, 1)
    assert census.asked == 1
    train(buffer, 1)
    assert census.asked == 1  # Four have changed, and no more.
    train(buffer, 1)
    assert census.asked == 2
    buffer.extend(make_transitions(5))
    train(buffer, 1)
    assert census.asked == 3
    assert census.told == [1, 1, 2, 3]


def test_count_gets_fused_priorities_of_known_signals():
    buffer, census = make_counted(8, 8, entropy_refresh=0)
    errors = torch.arange(8.0)
    set_signals(buffer, td_error=errors)
    assert census.priority.isnan().all()
    set_signals(buffer, td_error=errors)
    torch.testing.assert_close(census.priority, errors.double() + 0.05)


@pytest.mark.parametrize("way", ["state", "folder"])
def test_count_is_saved_and_later_batches_are_equal(way, tmp_path):
    def make(seed):
        replay = make_replay("mpfa_adaptive", capacity=200, batch_size=8, generator=seeded(seed))
        replay.buffer.extend(make_transitions(200, seed=seed))
        return replay

    def learn(replay, rounds):
        found = []
        for number in range(rounds):
            batch = replay.buffer.sample()
            for signal in replay.signals:
                batch["signals", signal] = torch.rand(8, generator=seeded(number)) * 3
            replay.buffer.update_tensordict_priority(batch)
            found.append(batch["index"])
        return torch.cat(found)

    first, second = make(0), make(1)
    learn(first, 3)  # Between two counts.
    restore(second.buffer, first.buffer, tmp_path if way == "folder" else None)
    assert learn(first, 20).equal(learn(second, 20))
    states = [replay.buffer.sampler.state_dict() for replay in (first, second)]
    assert [str(state["_counted"]) for state in states] == [str(states[0]["_counted"])] * 2


@pytest.mark.parametrize("value", [None, [], [torch.tensor(torch.nan), None], [1.0, None]])
def test_wrong_saved_count_is_rejected(value):
    first, second = (
        make_replay("mpfa_adaptive", capacity=9, batch_size=2).buffer.sampler for _ in range(2)
    )
    state = {**first.state_dict(), "_counted": value}
    if value == []:
        second.load_state_dict(state)
        return
    with pytest.raises(ValueError, match="'_counted' of the saved sampler must be empty, or"):
        second.load_state_dict(state)
    assert "_counted" not in make_replay("mpfa_per", capacity=9).buffer.sampler.state_dict()


def test_a_count_that_is_not_finite_is_rejected_and_changes_nothing():
    buffer, census = make_counted()
    census.count = lambda table, priority: torch.tensor(torch.nan)
    before = buffer.sampler.priorities()
    with pytest.raises(ValueError, match="what an adjustment counted must be finite"):
        train(buffer, 1)
    assert buffer.sampler.priorities().equal(before)


# Eq. 22 with a factor that follows the buffer.


def phi_by_hand(rewards, level, target, highest):
    positive = sum(reward > level for reward in rewards)
    if positive == 0:
        return highest
    ratio = target / (1 - target) * (len(rewards) - positive) / positive
    return min(max(ratio, 1.0), highest)


@pytest.mark.parametrize("level", [0.0, 1.0, 9.0])
def test_the_rarer_positive_transitions_are_the_larger_is_phi(level):
    rewards = torch.randn(40, generator=seeded(2))
    boost = PositiveBoost(boost=6.0, target_share=0.4)
    sampler = SignalSampler(
        40,
        0.6,
        0.4,
        0.0,
        signals=["td_error"],
        adjustments=[boost],
        positive_above=level,
        entropy_refresh=0,
    )
    buffer = make_buffer(sampler, 40, 8, filled=0)
    buffer.extend(TensorDict({"next": {"reward": rewards.unsqueeze(1)}}, [40]))
    errors = torch.rand(40, generator=seeded(3)) * 2
    set_signals(buffer, td_error=errors)
    phi = phi_by_hand(rewards.tolist(), level, 0.4, 6.0)
    expected = [
        max(phi * error, 1.0) if reward > level else error
        for error, reward in zip(errors.tolist(), rewards.tolist(), strict=True)
    ]
    assert sampler.priorities().tolist() == pytest.approx(expected, rel=1e-5)
