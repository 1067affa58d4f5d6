"""ReaPER: reliabilities against plain loops, and what they do to the frequencies."""

import pytest
import torch
from tensordict import TensorDict

from tests.methods.replays import assert_shares, seeded, set_signals
from torchrl_mpfa import SignalTensorStorage
from torchrl_mpfa.methods import Reliability, make_replay, reliability
from torchrl_mpfa.testing import check_adjustment

OMEGA, ALPHA, EPS = 0.3, 0.8, 0.05


def by_hand(errors, episodes, times):
    """One transition after the other, with every later one of its episode looked for."""
    found = []
    for time, episode in zip(times, episodes, strict=True):
        mine = [
            (0.0 if error != error else error, when)
            for error, other, when in zip(errors, episodes, times, strict=True)
            if other == episode
        ]
        total = sum(error for error, _ in mine)
        later = sum(error for error, when in mine if when > time)
        found.append(1.0 if total == 0 else 1 - later / total)
    return found


def make_rows(episodes, seed=0):
    count = len(episodes)
    return TensorDict(
        {
            "episode": torch.as_tensor(episodes).reshape(-1, 1),
            "next": {"reward": torch.randn(count, 1, generator=seeded(seed))},
        },
        [count],
    )


@pytest.mark.parametrize("seed", range(5))
def test_reliabilities_are_those_of_the_loops_however_episodes_lie_in_the_buffer(seed):
    episodes = torch.randint(6, (60,), generator=seeded(seed))
    times = torch.randperm(60, generator=seeded(seed + 10)).double()
    errors = torch.rand(60, generator=seeded(seed + 20)) * 3
    errors[::7] = torch.nan
    errors[episodes == 2] = 0.0
    found = reliability(errors, episodes.double(), times)
    expected = by_hand(errors.tolist(), episodes.tolist(), times.tolist())
    assert found.tolist() == pytest.approx(expected, abs=1e-6)


def test_large_errors_of_one_episode_do_not_round_those_of_another_away():
    errors = torch.tensor([1e9, 1e9, 1e-3, 3e-3], dtype=torch.double)
    found = reliability(errors, torch.tensor([0.0, 0.0, 1.0, 1.0]), torch.arange(4))
    assert found.tolist() == pytest.approx([0.5, 1.0, 0.25, 1.0], rel=1e-3)


def make_reaper(episodes, *, capacity=None, samples=60_000, **settings):
    replay = make_replay(
        "reaper",
        capacity=capacity or len(episodes),
        batch_size=samples,
        generator=seeded(0),
        alpha=ALPHA,
        reliability=OMEGA,
        eps=EPS,
        **settings,
    )
    replay.buffer.extend(make_rows(episodes))
    return replay.buffer


def test_frequencies_are_those_of_the_product():
    episodes = [0, 1, 0, 1, 0, 1, 2, 2, 0, 1]  # Two robots, step by step.
    errors = torch.rand(10, generator=seeded(3)) * 2
    buffer = make_reaper(episodes)
    for _ in range(2):  # At the first update no error was known.
        set_signals(buffer, td_error=errors)
    reliable = by_hand(errors.tolist(), episodes, list(range(10)))
    leaves = [
        r**OMEGA * (error + EPS) ** ALPHA
        for r, error in zip(reliable, errors.tolist(), strict=True)
    ]
    shares = torch.tensor([leaf / sum(leaves) for leaf in leaves], dtype=torch.double)
    assert_shares(buffer.sample()["index"], shares, samples=60_000)


def test_an_error_early_in_an_episode_of_errors_counts_less_than_the_same_error_at_its_end():
    """What bootstraps from badly known values, against what a reward alone makes."""
    buffer = make_reaper([0] * 50)
    for _ in range(2):
        set_signals(buffer, td_error=torch.ones(50))
    counts = torch.bincount(buffer.sample()["index"], minlength=50).double()
    assert counts[40:].mean() > 1.5 * counts[:10].mean()
    per = make_replay("per", capacity=50, batch_size=60_000, generator=seeded(0)).buffer
    per.extend(make_rows([0] * 50))
    set_signals(per, td_error=torch.ones(50))
    alike = torch.bincount(per.sample()["index"], minlength=50).double()
    assert alike[40:].mean() < 1.1 * alike[:10].mean()


def test_a_transition_in_the_place_of_an_old_one_does_not_have_its_reliability():
    buffer = make_reaper([0] * 400, samples=8)
    for _ in range(2):
        set_signals(buffer, td_error=torch.ones(400))
    table, slots = buffer._storage.signal_table, torch.arange(2)

    def learn():
        batch = TensorDict({"index": slots, "written_at": table.written_at(slots)}, [2])
        batch["signals", "td_error"] = torch.ones(2)
        buffer.update_tensordict_priority(batch)
        return buffer.sampler.priorities(slots).tolist()

    assert max(learn()) < 0.2  # The least reliable ones; all is counted anew here.
    buffer.extend(make_rows([1, 1]))  # In their places, and too few to count anew.
    assert learn() == pytest.approx([1 + EPS] * 2)


def test_it_goes_on_where_it_was_saved():
    first, second = (make_reaper([0, 0, 1, 1, 1, 2], samples=3) for _ in range(2))
    for _ in range(2):
        set_signals(first, td_error=torch.arange(6.0))
    second.load_state_dict(first.state_dict())
    for number in range(10):
        found = []
        for buffer in (first, second):
            batch = buffer.sample()
            batch["signals", "td_error"] = torch.rand(3, generator=seeded(number))
            buffer.update_tensordict_priority(batch)
            found.append(batch["index"])
        assert found[0].equal(found[1])


def test_what_is_missing_is_named():
    replay = make_replay("reaper", capacity=10, batch_size=2)
    assert replay.entries == ("episode",)
    assert make_replay("per", capacity=10).entries == ()
    with pytest.raises(KeyError, match="the transitions lack 'episode'"):
        replay.buffer.extend(TensorDict({"next": {"reward": torch.ones(2, 1)}}, [2]))
    with pytest.raises(ValueError, match=r"signals \['episode'\] of the sampler are not in the st"):
        make_replay("reaper", storage=SignalTensorStorage(10, signals=["td_error"]))
    with pytest.raises(ValueError, match="exponent must be positive and finite, got 0"):
        Reliability(0.0)
    with pytest.raises(ValueError, match=r"must keep the signals \['episode'\]"):
        check_adjustment(Reliability())
