"""What transforms keep from one write to the next, whichever transforms they are."""

import copy
import pickle
from collections import deque

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.transforms import Compose, MultiStepTransform, Transform

from tests.mpfa.transitions import make_buffer, rejected, restore, same, seeded, snapshot
from torchrl_mpfa.methods.her import HindsightGoals

WAIT = 3
"""Steps that wait in each transform."""


class Late(Transform):
    """A user's own: hands on each step three steps later, from a list that it writes in place."""

    def __init__(self):
        super().__init__()
        self.rows, self.seen, self.last = [], 0, torch.zeros(1)

    def _inv_call(self, tensordict):
        self.rows += [*tensordict.unbind(0)]
        self.seen += len(tensordict)
        self.last.copy_(tensordict["observation"][-1])
        ready = self.rows[:-WAIT]
        del self.rows[: len(ready)]
        return torch.stack(ready) if ready else None


class LateByWindow(Late):
    """The same with a window, and only its last step kept as a tensordict."""

    def __init__(self):
        super().__init__()
        self.rows = deque()

    def _inv_call(self, tensordict):
        self.rows.extend(tensordict.unbind(0))
        ready = [self.rows.popleft() for _ in range(max(len(self.rows) - WAIT, 0))]
        return torch.stack(ready) if ready else None


class LateByNumber(Late):
    """The same with a mapping from the number of a step."""

    def __init__(self):
        super().__init__()
        self.rows = {}

    def _inv_call(self, tensordict):
        for row in tensordict.unbind(0):
            self.rows[int(row["observation"])] = row
        ready = [self.rows.pop(key) for key in sorted(self.rows)[:-WAIT]]
        return torch.stack(ready) if ready else None


class LateWithState(Late):
    """The same by the protocol of PyTorch."""

    def get_extra_state(self):
        rows = [{"step": row["observation"], "seen": self.seen} for row in self.rows]
        return {"rows": rows, "last": self.last.clone()}

    def set_extra_state(self, state):
        self.rows = [steps(int(row["step"]), 1)[0] for row in state["rows"]]
        self.seen = state["rows"][0]["seen"] if state["rows"] else 0
        self.last = state["last"].clone()


class Repeat:
    """Writes an episode once more for one of its goals."""

    entries = ()

    def __call__(self, episode, steps):
        if (episode["observation"] == 99.0).any():
            raise ZeroDivisionError("no goals")
        return episode.clone()


TRANSFORMS = {
    "n-step": lambda: MultiStepTransform(n_steps=WAIT, gamma=1.0, done_keys=["done"]),
    "n-step within": lambda: Compose(MultiStepTransform(WAIT, 1.0, done_keys=["done"])),
    "hindsight": lambda: HindsightGoals(Repeat(), goals=1, generator=seeded(1)),
    "list": Late,
    "window": LateByWindow,
    "mapping": LateByNumber,
    "extra state": LateWithState,
}


def steps(first, count, *, end=None):
    at = torch.arange(first, first + count).float().unsqueeze(1)
    done = torch.zeros(count, 1, dtype=torch.bool)
    if end is not None:
        done[end] = True
    after = {"observation": at + 1, "reward": torch.ones(count, 1), "done": done}
    rows = {"observation": at, "action": torch.zeros(count, 1), "next": after}
    return TensorDict({**rows, "episode": torch.zeros(count, 1, dtype=torch.long)}, [count])


def make(kind, **kwargs):
    return make_buffer(60, transform=TRANSFORMS[kind](), **kwargs)


def held(buffer):
    """The whole state of a buffer but for slots that are not filled."""
    state = snapshot(buffer)
    state["_storage"].pop("_storage")
    return {**state, "rows": buffer[:].to_dict()}


def writes():
    """Writes of one long episode, then of the end of it."""
    return [steps(0, 4), steps(4, 1), steps(5, 6, end=5)]


def spoiled(change):
    rows = steps(5, 6, end=5)
    change(rows)
    return rows


def set_last(key, value):
    return lambda rows: rows[key].__setitem__(-1, value)


BAD = {
    "NaN in what is kept": set_last("action", torch.nan),
    "NaN in what is stored": lambda rows: rows["next", "reward"].__setitem__(0, torch.nan),
    "another type": lambda rows: rows.set("action", rows["action"].double()),
    "another width": lambda rows: rows.set("action", torch.zeros(6, 2)),
    "an entry less": lambda rows: rows.pop("action"),
    "a negative priority": lambda rows: rows.set("td_error", torch.full((6,), -1.0)),
    "too high a priority": lambda rows: rows.set("td_error", torch.full((6,), 1e300).double() ** 2),
}


@pytest.mark.parametrize("kind", TRANSFORMS)
@pytest.mark.parametrize("bad", BAD)
def test_rejected_write_changes_nothing_in_transforms(kind, bad):
    buffer, other = make(kind), make(kind)
    for place, each in enumerate(writes()):
        if place == 2:
            with rejected(buffer, Exception):
                buffer.extend(spoiled(BAD[bad]))
        assert torch.equal(buffer.extend(each), other.extend(each))
    for each in (buffer, other):
        each.extend(steps(11, 7))
    assert same(held(buffer), held(other))


def test_attribute_that_a_rejected_write_added_is_gone():
    class Adds(Transform):
        def _inv_call(self, tensordict):
            self.added = True
            return tensordict

    buffer = make_buffer(60, transform=Adds())
    with rejected(buffer, ValueError, "must be finite"):
        buffer.extend(spoiled(BAD["NaN in what is stored"]))
    assert not hasattr(buffer.transform[0], "added")


@pytest.mark.parametrize("own", [True, False], ids=["own generator", "PyTorch's"])
def test_relabeling_that_raises_changes_neither_goals_nor_random_numbers(own):
    def make_hindsight():
        torch.manual_seed(3)
        generator = seeded(1) if own else None
        return make_buffer(60, transform=HindsightGoals(Repeat(), goals=1, generator=generator))

    buffer = make_hindsight()
    buffer.extend(steps(0, 4))
    bad = steps(4, 3, end=2)
    bad["observation"][1] = 99.0
    bad["next", "observation"][0] = 99.0
    before = torch.get_rng_state()
    with rejected(buffer, ZeroDivisionError):
        buffer.extend(bad)
    assert torch.equal(before, torch.get_rng_state())
    buffer.extend(steps(4, 3, end=2))
    found = held(buffer)
    other = make_hindsight()
    other.extend(steps(0, 4))
    other.extend(steps(4, 3, end=2))
    assert same(found, held(other))
    if own:
        states = [each.transform[0].generator.get_state() for each in (buffer, other)]
        assert torch.equal(*states)


def loaded_again(kind, way, folder):
    """A buffer in whose transform steps wait, and another one that was loaded from it."""
    buffer, again = make(kind), make(kind)
    again.extend(steps(40, 5))  # A load replaces what waits.
    for each in writes()[:2]:
        buffer.extend(each)
    if way in ("state", "folder"):
        restore(again, buffer, folder / "replay" if way == "folder" else None)
    else:
        again = pickle.loads(pickle.dumps(buffer)) if way == "pickle" else copy.deepcopy(buffer)
    for each in (buffer, again):
        each.extend(writes()[2])
        each.extend(steps(11, 7))
    return buffer, again


SAVED = [(kind, way) for kind in ("hindsight", "extra state") for way in ("state", "folder")]
COPIED = [(kind, way) for kind in TRANSFORMS for way in ("pickle", "copy")]


@pytest.mark.parametrize(("kind", "way"), SAVED + COPIED)
def test_waiting_steps_are_saved_and_written_after_a_load(kind, way, tmp_path):
    buffer, again = loaded_again(kind, way, tmp_path)
    assert same(held(buffer), held(again))
    assert len(buffer) > 10


@pytest.mark.parametrize("kind", ["n-step", "n-step within", "list", "window", "mapping"])
@pytest.mark.parametrize("way", ["state", "folder"])
def test_waiting_steps_that_are_not_saved_are_lost_and_no_row_is_wrong(kind, way, tmp_path):
    buffer, again = loaded_again(kind, way, tmp_path)
    ends = "observation", ("next", "observation")
    rows, found = (
        set(map(tuple, torch.cat([b[:][key] for key in ends], 1).tolist())) for b in (buffer, again)
    )
    assert found < rows
    assert sorted(first for first, _ in rows - found) == [2.0, 3.0, 4.0]


@pytest.mark.parametrize("kind", TRANSFORMS)
def test_emptied_buffer_keeps_settings_and_no_waiting_steps(kind):
    buffer, fresh = make(kind), make(kind)
    with rejected(buffer, ValueError, "must be finite"):  # It leaves copies in the transform.
        buffer.extend(spoiled(BAD["NaN in what is kept"]))
    for first in (20, 30):
        for begin in (first, first + 4):
            buffer.extend(steps(begin, 4))
        if kind == "n-step":
            for each in (buffer, fresh):
                each.transform[0].n_steps = 2
        buffer.empty()
    found = [each.extend(steps(0, 8)).tolist() for each in (buffer, fresh)]
    assert found[0] == found[1]
    assert torch.equal(buffer[:]["observation"], fresh[:]["observation"])


@pytest.mark.parametrize("kind", TRANSFORMS)
def test_waiting_steps_share_no_tensors_with_the_caller(kind):
    buffer, other = make(kind), make(kind)
    mine = steps(0, 2)
    for first in range(0, 10, 2):
        mine.copy_(steps(first, 2))
        buffer.extend(mine)
        other.extend(steps(first, 2))
    assert torch.equal(buffer[:]["observation"], other[:]["observation"])


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (3, "the saved unfinished episodes must be"),
        ({"reward": torch.full((2,), torch.nan)}, "entry 'reward' must be finite, got nan"),
    ],
)
def test_wrong_state_of_unfinished_episodes_is_rejected_and_changes_nothing(wrong, words):
    buffer = make("hindsight")
    buffer.extend(steps(0, 4))
    state = snapshot(buffer)
    (name,) = [name for name in state["_transforms"] if name.endswith("_extra_state")]
    state["_transforms"][name] = wrong
    with rejected(buffer, ValueError, words):
        buffer.load_state_dict(state)
