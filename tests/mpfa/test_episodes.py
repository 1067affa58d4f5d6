"""Steps that do not follow each other are never joined, whatever number they have."""

import pytest
import torch
from tensordict import TensorDict

from tests.mpfa.transitions import make_buffer, restore, seeded, snapshot
from torchrl_mpfa import SignalSliceSampler
from torchrl_mpfa.episodes import episodes_of
from torchrl_mpfa.methods import make_replay
from torchrl_mpfa.methods.her import HindsightGoals
from torchrl_mpfa.methods.reaper import reliability

LENGTH, CAPACITY = 3, 200


class Robot:
    """A collector: its steps are numbered from 0, as those of every other one."""

    def __init__(self, name, *, ends=7, seen=True):
        self.name, self.at, self.ends, self.seen = name, 0, ends, seen

    def steps(self, count):
        at = torch.arange(self.at, self.at + count)
        self.at += count
        place = (1000.0 * self.name + at).unsqueeze(1)
        episode = (at // self.ends).unsqueeze(1)
        end = (at % self.ends == self.ends - 1).unsqueeze(1)
        # After a reset it is elsewhere.
        rows = {"observation": place + 0.5 * episode, "episode": episode}
        after = {"reward": torch.ones(count, 1), "done": end, "terminated": end}
        if self.seen:
            after["observation"] = rows["observation"] + 1.0
        rows["collector"] = TensorDict({"traj_ids": episode.squeeze(1)}, [count])
        return TensorDict(
            {**rows, "robot": torch.full((count, 1), self.name), "next": after}, [count]
        )


def make_slices(**options):
    sampler = SignalSliceSampler(CAPACITY, 0.6, 0.4, slice_len=LENGTH, signals=["td_error"])
    return make_buffer(CAPACITY, 100 * LENGTH, sampler=sampler, **options)


def starts(buffer):
    """Robot and place of the first step of each slice that can be sampled."""
    slots = (buffer.sampler.batch_weights(len(buffer)) > 0).nonzero().squeeze(1)
    rows = buffer[:]
    return {(int(rows["robot"][slot]), int(rows["observation"][slot])) for slot in slots}


def whole_slices(rows):
    """The same in a plain loop: steps of one robot and one episode, one after the other."""
    known = {
        (int(r), float(o)): (int(e), bool(d))
        for r, o, e, d in zip(
            rows["robot"], rows["observation"], rows["episode"], rows["next", "done"], strict=True
        )
    }
    found = set()
    for robot, place in known:
        steps = [known.get((robot, place + step)) for step in range(LENGTH)]
        if None not in steps and not any(done for _, done in steps[:-1]):
            found.add((robot, int(place)))
    return found


@pytest.mark.parametrize("kind", ["restart", "load", "load from a folder", "in turn", "one by one"])
def test_slices_join_no_steps_of_two_collectors(kind, tmp_path):
    buffer, first, second = make_slices(), Robot(1), Robot(2)
    if kind == "one by one":
        for step in [*first.steps(5), *second.steps(5)]:
            buffer.add(step)
    else:
        buffer.extend(first.steps(5))  # In the middle of an episode.
        if kind.startswith("load"):
            again = make_slices()
            restore(again, buffer, tmp_path / "replay" if kind.endswith("folder") else None)
            buffer = again
        buffer.extend(second.steps(5))
    if kind == "in turn":
        buffer.extend(first.steps(10))
        buffer.extend(second.steps(10))
    rows = buffer[:]
    found = starts(buffer)
    assert found <= whole_slices(rows)
    # A collector's own steps are joined where they lie one after the other.
    assert {(1, 1000), (2, 2000)} <= found


def test_steps_of_one_collector_are_joined_across_writes_and_a_load():
    buffer, again, robot = make_slices(), make_slices(), Robot(1, ends=100)
    buffer.extend(robot.steps(5))
    again.load_state_dict(snapshot(buffer))
    again.extend(robot.steps(5))
    assert starts(again) == {(1, 1000 + step) for step in range(8)}


def test_without_observations_steps_after_a_load_follow_none_of_before():
    buffer, again, robot = make_slices(), make_slices(), Robot(1, ends=100, seen=False)
    buffer.extend(robot.steps(5))
    again.load_state_dict(snapshot(buffer))
    again.extend(robot.steps(5))
    assert starts(again) == {(1, 1000 + step) for step in (0, 1, 2, 5, 6, 7)}


def test_places_that_are_not_a_number_and_both_zeros_are_alike():
    rows = Robot(0).steps(4)
    rows["observation"][1] = rows["next", "observation"][0] = torch.nan
    rows["observation"][2], rows["next", "observation"][1] = 0.0, -0.0
    rows["observation"][3] = 9.0
    number, none = torch.zeros(4), torch.zeros(4, dtype=torch.bool)
    assert episodes_of(rows, torch.arange(4), number, none).tolist() == [0, 0, 0, 3]


def test_step_that_begins_where_an_episode_ended_begins_another():
    last = torch.tensor([False, True, False, False])
    episodes = episodes_of(Robot(0).steps(4), torch.arange(4), torch.zeros(4), last)
    assert episodes.tolist() == [0, 0, 2, 2]


class KeepEpisode:
    """Writes the whole episode once more."""

    entries = ("robot",)

    def __init__(self):
        self.seen = []

    def __call__(self, episode, steps):
        self.seen.append(
            (episode["robot"].flatten().tolist(), episode["observation"].flatten().tolist())
        )
        return episode.exclude("robot").clone()


@pytest.mark.parametrize("kind", ["restart", "load", "in turn", "one by one"])
def test_hindsight_learns_of_one_episode_at_a_time(kind):
    relabel, again = KeepEpisode(), KeepEpisode()
    buffer = make_replay("her", capacity=CAPACITY, batch_size=8).buffer
    buffer.append_transform(HindsightGoals(relabel, goals=1))
    first, second = Robot(1), Robot(2)
    buffer.extend(first.steps(4))
    if kind == "load":
        other = make_replay("her", capacity=CAPACITY, batch_size=8).buffer
        other.append_transform(HindsightGoals(again, goals=1))
        other.load_state_dict(snapshot(buffer))
        buffer, relabel = other, again
    for _ in range(10 if kind == "one by one" else 1):
        buffer.extend(second.steps(1 if kind == "one by one" else 10))
        if kind == "one by one":
            buffer.extend(first.steps(1))
    if kind == "in turn":
        buffer.extend(first.steps(10))
    expected = 1 if kind in ("restart", "load") else 3
    assert len(relabel.seen) >= expected
    for robots, places in relabel.seen:
        assert len(set(robots)) == 1 and len(places) == 7
        assert torch.tensor(places).diff().unique().tolist() == [1.0]


def test_of_too_many_episodes_those_that_were_written_last_continue(monkeypatch):
    monkeypatch.setattr("torchrl_mpfa.methods.reaper._UNDER_WAY", 2)
    buffer = make_replay("reaper", capacity=CAPACITY, batch_size=8).buffer
    robots = [Robot(number) for number in range(3)]
    for robot in (*robots, *robots[1:]):
        buffer.extend(robot.steps(1))
        buffer.sampler._number(buffer.sampler.table)
    assert buffer.sampler._episodes[:5].tolist() == [1, 2, 3, 2, 3]


@pytest.mark.parametrize("load", [False, True])
@pytest.mark.parametrize("at_a_time", [1, 4, 10])
def test_reliability_is_that_of_one_episode_at_a_time(load, at_a_time):
    def make():
        return make_replay(
            "reaper",
            capacity=CAPACITY,
            batch_size=8,
            reliability=0.5,
            alpha=1.0,
            max_priority_within_buffer=True,
        ).buffer

    buffer, robots, generator = make(), [Robot(1), Robot(2, ends=5)], seeded(3)
    for turn in range(24 // at_a_time):
        if load and turn == 12 // at_a_time:
            again = make()
            again.load_state_dict(snapshot(buffer))
            buffer = again
        for robot in robots:
            buffer.extend(robot.steps(at_a_time))
    slots = torch.arange(len(buffer))
    errors = torch.rand(len(buffer), generator=generator) + 0.1
    buffer.sampler.update_signals(slots, {"td_error": errors}, storage=buffer.storage)
    rows = buffer[:]
    episode = 100 * rows["robot"].flatten() + rows["episode"].flatten()
    ended = torch.zeros(400, dtype=torch.bool)
    ended[episode[rows["next", "done"].flatten()]] = True
    sums = torch.zeros(400).index_add_(0, episode, errors)
    total = torch.where(ended, sums, sums[ended].max())[episode]
    share = reliability(errors, episode, slots, total=total).clamp_min(1e-3)
    expected = share.pow(0.5) * (errors.double() + buffer.sampler._eps)
    weights = buffer.sampler.batch_weights(len(buffer))
    beta = buffer.sampler.beta
    assert torch.allclose(weights, (expected / expected.min()).pow(-beta), rtol=1e-5)
