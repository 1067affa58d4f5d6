"""ReaPER: reliabilities against plain loops, and the authors' rules in the leaves of the tree."""

import random

import pytest
import torch
from tensordict import TensorDict

from tests.mpfa.transitions import seeded, set_signals
from torchrl_mpfa.methods import make_replay
from torchrl_mpfa.methods.reaper import reliability

OMEGA, ALPHA, EPS = 0.4, 0.8, 0.05


def by_hand(errors, episodes, times, totals=None):
    """One transition after the other, with every earlier one of its episode looked for."""
    found = []
    for row, (time, episode) in enumerate(zip(times, episodes, strict=True)):
        mine = [
            (error, when)
            for error, other, when in zip(errors, episodes, times, strict=True)
            if other == episode
        ]
        total = sum(error for error, _ in mine) if totals is None else totals[row]
        until = sum(error for error, when in mine if when <= time)
        found.append(1.0 if total == 0 else min(until / total, 1.0))
    return found


def make_rows(episodes, done=None, seed=0):
    count = len(episodes)
    ended = torch.zeros(count, 1, dtype=torch.bool) if done is None else torch.tensor(done)
    return TensorDict(
        {
            "episode": torch.as_tensor(episodes).reshape(-1, 1),
            "next": {
                "reward": torch.randn(count, 1, generator=seeded(seed)),
                "done": ended.reshape(-1, 1),
            },
        },
        [count],
    )


@pytest.mark.parametrize("seed", range(2))
def test_reliabilities_are_those_of_the_loops_however_episodes_lie_in_the_buffer(seed):
    episodes = torch.randint(6, (60,), generator=seeded(seed))
    times = torch.randperm(60, generator=seeded(seed + 10)).double()
    errors = torch.rand(60, generator=seeded(seed + 20)) * 3
    errors[episodes == 2] = 0.0
    totals = torch.rand(60, generator=seeded(seed + 30)) * 20
    for total in (None, totals):
        found = reliability(errors, episodes.double(), times, total=total)
        listed = None if total is None else total.tolist()
        expected = by_hand(errors.tolist(), episodes.tolist(), times.tolist(), listed)
        assert found.tolist() == pytest.approx(expected, abs=1e-6)


def test_large_errors_of_one_episode_do_not_round_those_of_another_away():
    errors = torch.tensor([1e9, 1e9, 1e-3, 3e-3], dtype=torch.double)
    found = reliability(errors, torch.tensor([0.0, 0.0, 1.0, 1.0]), torch.arange(4))
    assert found.tolist() == pytest.approx([0.5, 1.0, 0.25, 1.0], rel=1e-3)


class Rules:
    """The authors' buffer, row by row; rows are dictionaries in the order of writing."""

    def __init__(self):
        self.rows, self.highest = [], 1.0

    def write(self, slot, episode, done):
        self.rows = [row for row in self.rows if row["slot"] != slot]
        # As long as nothing else of its episode changes it is sampled by its error alone.
        fresh = {"slot": slot, "episode": episode, "error": self.highest, "done": done}
        self.rows.append({**fresh, "leaf": (self.highest + EPS) ** ALPHA})
        if done:
            self.rely({episode})

    def learn(self, slots, errors):
        for row in self.rows:
            if row["slot"] in slots:
                row["error"] = errors[slots.index(row["slot"])]
                self.highest = max(self.highest, row["error"])
        self.rely({row["episode"] for row in self.rows if row["slot"] in slots})

    def rely(self, episodes):
        sums, ended = {}, {row["episode"] for row in self.rows if row["done"]}
        for row in self.rows:
            sums[row["episode"]] = sums.get(row["episode"], 0.0) + row["error"]
        largest = max((sums[one] for one in ended), default=0.0)
        until = {}
        for row in self.rows:
            one = row["episode"]
            until[one] = until.get(one, 0.0) + row["error"]
            total = sums[one] if one in ended else largest
            if one in episodes:
                share = min(until[one] / total, 1.0) if total > 0 else 1.0
                row["leaf"] = max(share, 1e-3) ** OMEGA * (row["error"] + EPS) ** ALPHA


@pytest.mark.parametrize(("seed", "number"), [(0, 1), (2, 0.5)])
def test_leaves_are_those_of_the_authors_rules_through_writes_and_updates(seed, number):
    """Three robots, a buffer of thirty that wraps, one or two batches an update, duplicates."""
    choose, capacity = random.Random(seed), 30
    buffer = make_reaper([], capacity=capacity, samples=8)
    rules, episodes, latest, slot = Rules(), [0, 1, 2], 2, 0
    for _ in range(60):
        done = [choose.random() < 0.2 for _ in episodes]
        buffer.extend(make_rows([number * one for one in episodes], done))
        for robot, ends in enumerate(done):
            rules.write(slot % capacity, episodes[robot], ends)
            slot += 1
        for robot, ends in enumerate(done):
            if ends:
                latest += 1
                episodes[robot] = latest
        count = choose.choice([1, 5])
        filled = min(slot, capacity)
        slots = choose.sample(range(filled), min(count, filled))
        errors = [choose.choice([0.0, choose.random() * 3]) for _ in slots]
        table = buffer.storage.signal_table
        index = torch.tensor(slots)
        batch = TensorDict({"index": index, "written_at": table.written_at(index)}, [len(slots)])
        batch["signals", "td_error"] = torch.tensor(errors)
        buffer.update_tensordict_priority(batch)
        rules.learn(slots, errors)
        places = torch.tensor([row["slot"] for row in rules.rows])
        leaves = buffer.sampler.trees.leaves(places).tolist()
        assert leaves == pytest.approx([row["leaf"] for row in rules.rows], rel=1e-5)


def make_reaper(episodes, done=None, *, capacity=None, samples=60_000, **settings):
    replay = make_replay(
        "reaper",
        capacity=capacity or len(episodes),
        batch_size=samples,
        generator=seeded(0),
        **{"alpha": ALPHA, "reliability": OMEGA, "eps": EPS, **settings},
    )
    if len(episodes):
        replay.buffer.extend(make_rows(episodes, done))
    return replay.buffer


def test_exponents_are_those_of_the_authors():
    sampler = make_replay("reaper").buffer.sampler
    assert (sampler.exponent, sampler.alpha) == (0.3, 0.3)


def test_another_alpha_keeps_the_reliabilities():
    done = [False, True, False, False, True]
    errors = torch.rand(5, generator=seeded(3))
    buffer = make_reaper([0, 0, 1, 1, 1], done)
    set_signals(buffer, td_error=errors)
    buffer.sampler.alpha = 0.5
    again = make_reaper([0, 0, 1, 1, 1], done, alpha=0.5)
    set_signals(again, td_error=errors)
    slots = torch.arange(5)
    assert buffer.sampler.trees.leaves(slots).equal(again.sampler.trees.leaves(slots))


def test_missing_entry_or_part_is_named():
    replay = make_replay("reaper", capacity=10, batch_size=2)
    assert replay.entries == ("episode",)
    assert make_replay("per", capacity=10).entries == ()
    with pytest.raises(KeyError, match="the transitions lack 'episode'"):
        replay.buffer.extend(make_rows([0, 0]).exclude("episode"))
    with pytest.raises(KeyError, match="the transitions lack 'ended'"):
        replay.buffer.extend(make_rows([0, 0]).exclude(("next", "done")))
