"""Hindsight: which episodes are written once more, for which goals, against plain loops."""

import pytest
import torch
from tensordict import TensorDict
from torch.utils._pytree import tree_leaves

from tests.mpfa.transitions import seeded
from torchrl_mpfa.methods import make_replay
from torchrl_mpfa.methods.her import HindsightGoals, future_goals

ROBOTS = 3


class ReachPlace:
    """The goal is a place that was reached; the episode ends there, with a reward."""

    entries = ("place", ("next", "place"))

    def __init__(self):
        self.steps = []

    def __call__(self, episode, steps):
        self.steps.append(steps.tolist())
        found = []
        for step in steps.tolist():
            rows = episode[: step + 1].exclude(*self.entries).clone()
            rows["observation"][:, 1] = episode["next", "place"][step, 0]
            rows["next", "reward"][-1], rows["next", "done"][-1] = 10.0, True
            found.append(rows)
        return torch.cat(found)


class Drive:
    """Robots whose episodes have lengths at random; place and goal are in what they observe."""

    def __init__(self, seed=0):
        self.rng = seeded(seed)
        self.begun = ROBOTS
        self.numbers, self.places = list(range(ROBOTS)), [0.0] * ROBOTS

    def step(self):
        """One row of each robot."""
        rows = []
        for robot in range(ROBOTS):
            place, number = self.places[robot], self.numbers[robot]
            after = place + 1.0 + 0.1 * robot
            done = bool(torch.rand((), generator=self.rng) < 0.25)
            rows.append((number, place, after, done))
            self.places[robot] = 0.0 if done else after
            if done:
                self.numbers[robot] = self.begun
                self.begun += 1
        return rows


def as_tensordict(rows):
    number, place, after, done = (torch.tensor(each) for each in zip(*rows, strict=True))

    def seen(places):
        return torch.stack((places, torch.full_like(places, 99.0)), -1)

    return TensorDict(
        {
            "observation": seen(place),
            "action": torch.zeros(len(rows), 2),
            "place": place.unsqueeze(-1),
            "episode": number.unsqueeze(-1),
            "next": {
                "observation": seen(after),
                "place": after.unsqueeze(-1),
                "reward": torch.zeros(len(rows), 1),
                "done": done.unsqueeze(-1),
                "terminated": done.unsqueeze(-1),
            },
        },
        [len(rows)],
    )


def hindsight_by_hand(calls, steps):
    """What is stored of some writes: (place, goal, reward) of each row, in plain loops."""
    stored, episodes, steps = [], {}, iter(steps)
    for rows in calls:
        for number, place, after, _ in rows:
            stored.append((place, 99.0, 0.0))
            episodes.setdefault(number, []).append((place, after))
        for number in [number for number, *_, done in rows if done]:
            episode = episodes.pop(number)
            for step in next(steps):
                goal = episode[step][1]
                for index in range(step + 1):
                    stored.append((episode[index][0], goal, 10.0 * (index == step)))
    return stored


def stored_in(buffer):
    data = buffer.storage[:]
    places, goals = data["observation"].unbind(-1)
    rewards = data["next", "reward"].squeeze(-1)
    return list(zip(places.tolist(), goals.tolist(), rewards.tolist(), strict=True))


def make_her(method="her", *, generator=0, **settings):
    replay, relabel = make_replay(method, capacity=2000, batch_size=400), ReachPlace()
    goals = HindsightGoals(relabel, generator=seeded(generator), **settings)
    replay.buffer.append_transform(goals)
    return replay.buffer, relabel


@pytest.mark.parametrize("together", [1, 7])
def test_stored_rows_equal_those_of_plain_loops(together):
    buffer, relabel = make_her(goals=2)
    robots, calls = Drive(), []
    for _ in range(42 // together):
        # A rollout has the rows of one robot after those of another.
        steps = [robots.step() for _ in range(together)]
        calls.append([step[robot] for robot in range(ROBOTS) for step in steps])
        index = buffer.extend(as_tensordict(calls[-1]).reshape(ROBOTS, together))
        assert index.tolist() == list(range(len(buffer)))[-len(index) :]
    lengths = {}
    for rows in calls:
        for number, *_ in rows:
            lengths[number] = lengths.get(number, 0) + 1
    expected = hindsight_by_hand(calls, relabel.steps)
    torch.testing.assert_close(torch.tensor(stored_in(buffer)), torch.tensor(expected))
    ended = [number for rows in calls for number, *_, done in rows if done]
    assert len(relabel.steps) == len(ended) >= 20
    for number, steps in zip(ended, relabel.steps, strict=True):
        assert len(set(steps)) == len(steps) == min(2, lengths[number])
        assert set(steps) <= set(range(lengths[number]))
    assert set(buffer.storage[:].keys(True, True)) == {
        *("observation", "action", "index"),
        *(("next", name) for name in ("observation", "reward", "done", "terminated")),
    }


def test_goals_are_the_outcome_of_each_step_equally_often():
    generator, counts = seeded(3), torch.zeros(10)
    for _ in range(4000):
        counts[future_goals(10, 3, generator)] += 1
    assert counts.sum() == 12_000
    torch.testing.assert_close(counts / 4000, torch.full((10,), 0.3), rtol=0, atol=0.03)


@pytest.mark.parametrize("method", ["per", "mpfa_per"])
def test_rows_in_hindsight_have_priorities_of_their_own(method):
    buffer, _ = make_her(method, goals=1)
    robots = Drive()
    while len(buffer) < 40:
        buffer.extend(as_tensordict(robots.step()))
    goals = buffer.storage[:]["observation"][:, 1] != 99.0
    assert 0 < goals.sum() < len(goals)
    batch = buffer.sample()
    names = [signal.name for signal in buffer.sampler.signals if signal.known_at == "update"]
    # The goal in hindsight is what the learner knows nothing of.
    error = torch.where(goals[batch["index"]], 100.0, 0.01)
    batch["signals"] = TensorDict({name: error for name in names}, [400])
    buffer.update_tensordict_priority(batch)
    assert goals[buffer.sample()["index"]].float().mean() > 0.9


def test_unfinished_episodes_continue_from_a_saved_state(tmp_path):
    def write(buffer, robots, count):
        for _ in range(count):
            buffer.extend(as_tensordict(robots.step()))

    whole, _ = make_her(goals=3)
    robots = Drive()
    write(whole, robots, 10)
    torch.save(whole.state_dict(), tmp_path / "state.pt")
    before = whole._transform[0].generator.get_state()
    resumed, relabel = make_her(goals=3)
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    resumed.load_state_dict(state)
    for part in tree_leaves(state["_transforms"]):
        part.zero_()  # Nothing of it is shared.
    resumed._transform[0].generator.set_state(before)
    for _ in range(12):
        rows = as_tensordict(robots.step())
        assert torch.equal(whole.extend(rows), resumed.extend(rows))
    assert stored_in(resumed) == stored_in(whole)
    assert max(map(max, relabel.steps)) > 2  # Some episodes began before the state was saved.
    fresh, _ = make_her(goals=3)
    fresh.load_state_dict(make_her()[0].state_dict() | {"_storage": fresh.storage.state_dict()})
    assert not fresh._transform[0]._pending


@pytest.mark.parametrize("missing", ["episode", "place", ("next", "place")], ids=str)
def test_row_without_an_entry_of_goals_is_rejected_and_changes_nothing(missing):
    buffer, _ = make_her()
    rows = as_tensordict(Drive().step())
    rows["next", "done"][:] = False
    buffer.extend(rows)
    with pytest.raises(KeyError, match="transitions for goals in hindsight must have"):
        buffer.extend(rows.exclude(missing))
    assert len(buffer) == ROBOTS
    assert len(torch.cat(buffer._transform[0]._pending)) == ROBOTS


def test_method_with_hindsight_names_its_entries():
    assert make_replay("her").entries == ("episode",)
    assert make_replay("per", hindsight=1).entries == ("episode",)
    assert make_replay("per").entries == ()
