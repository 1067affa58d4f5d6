"""Transitions that do not fit are rejected before they are written, and padding is left out."""

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from torchrl.collectors.utils import split_trajectories
from torchrl.data import TensorDictMaxValueWriter
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.envs.transforms import MultiStepTransform

from tests.mpfa.compiled import fail_with
from tests.mpfa.transitions import make_buffer, rejected, same, seeded, snapshot, train_rounds
from torchrl_mpfa import (
    FixedFusion,
    MPFASampler,
    SignalMemmapStorage,
    SignalSliceSampler,
    SignalTensorStorage,
)
from torchrl_mpfa.methods.her import HindsightGoals
from torchrl_mpfa.methods.reaper import ReaPERSampler
from torchrl_mpfa.samplers import TreeSampler
from torchrl_mpfa.storages.plan import NewRows

CAPACITY = 8


class Nothing:
    """Relabels an episode as it was."""

    entries = ()

    def __call__(self, episode, steps):
        return episode[:0].clone()


def make_full_transitions(count, value=1.0):
    """Transitions with every entry of navigation, all of one number."""
    end = torch.zeros(count, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": torch.full((count, 3), value),
            "action": torch.full((count, 2), value),
            "next": {
                "observation": torch.full((count, 3), value + 1),
                "reward": torch.full((count, 1), value),
                "done": end,
                "terminated": end.clone(),
            },
        },
        [count],
    )


def changed(key, value):
    def change(data):
        data[key] = value

    return change


def removed(key):
    def change(data):
        del data[key]

    return change


NAN = torch.tensor([[1.0], [torch.nan]])
BAD = {
    "reward in double": (
        changed(("next", "reward"), torch.ones(2, 1, dtype=torch.double)),
        r"\('next', 'reward'\) must be torch.float32 as in the storage, got torch.float64",
    ),
    "wide action": (
        changed("action", torch.ones(2, 3)),
        r"'action' must have the shape \[2\] in each transition, got \[3\]",
    ),
    "integer done": (
        changed(("next", "done"), torch.zeros(2, 1, dtype=torch.long)),
        r"\('next', 'done'\) must be torch.bool as in the storage, got torch.int64",
    ),
    "no next observation": (
        removed(("next", "observation")),
        r"\('next', 'observation'\) is missing in the transitions",
    ),
    "unknown entry": (changed("loc", torch.ones(2, 2)), r"'loc' is not in the storage"),
    "unknown entries": (
        changed("more", TensorDict({"loc": torch.ones(2, 2)}, [2])),
        r"'more' is not in the storage",
    ),
    "entries in place of a tensor": (
        changed("action", TensorDict({"a": torch.ones(2, 2)}, [2])),
        r"'action' must be a tensor, got TensorDict",
    ),
    "a tensor in place of entries": (
        changed("next", torch.ones(2, 1)),
        r"'next' must hold entries",
    ),
    "NaN reward": (
        changed(("next", "reward"), NAN),
        r"\('next', 'reward'\) must be finite, got nan in row 1",
    ),
    "infinite next observation": (
        changed(("next", "observation"), torch.tensor([[1.0, 1, 1], [1, -torch.inf, 1]])),
        r"\('next', 'observation'\) must be finite, got -inf in row 1",
    ),
    "negative priority": (
        changed("td_error", torch.tensor([1.0, -1.0])),
        r"'td_error' of the transitions must be finite and not negative, got -1.0",
    ),
}


@pytest.fixture(params=["memory", "memmap", "uniform"])
def buffer(request, tmp_path):
    """A full ring in the middle of its training."""
    if request.param == "uniform":
        buffer = make_buffer(CAPACITY, sampler=RandomSampler())
        buffer.extend(make_full_transitions(CAPACITY))
        return buffer
    kind = SignalTensorStorage if request.param == "memory" else SignalMemmapStorage
    kwargs = {} if request.param == "memory" else {"scratch_dir": tmp_path}
    buffer = make_buffer(CAPACITY, storage=kind(CAPACITY, **kwargs))
    buffer.extend(make_full_transitions(CAPACITY + 3))
    train_rounds(buffer, 3)
    return buffer


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("way", ["add", "lazy stack"])
def test_wrong_transitions_are_rejected_by_name_and_change_nothing(buffer, name, way):
    change, message = BAD[name]
    data = make_full_transitions(2, 9.0)
    change(data)
    with rejected(buffer, (KeyError, ValueError), message.replace("row 1", "row [01]")):
        if way == "add":
            buffer.add(data[1])
        else:
            buffer.extend(lazy_stack(list(data.unbind(0))))
    # What comes next is what would have come without it.
    twin = deepcopy(buffer)
    assert (
        twin.extend(make_full_transitions(1)).tolist()
        == buffer.extend(make_full_transitions(1)).tolist()
    )
    assert same(twin.sample(), buffer.sample())


@pytest.mark.parametrize("kind", [TreeSampler, MPFASampler])
def test_a_rejected_extend_is_not_remembered_by_a_writer_that_keeps_the_best(kind):
    writer = TensorDictMaxValueWriter(rank_key=("next", "reward"))
    buffer = make_buffer(4, sampler=kind(4, 0.6, 0.4), writer=writer)
    for value in (1.0, 2.0, 3.0, 4.0):
        buffer.extend(make_full_transitions(1, value))
    bad = make_full_transitions(2, 100.0)
    bad["observation"][0] = torch.nan
    with pytest.raises(ValueError, match="'observation' must be finite, got nan in row 0"):
        buffer.extend(bad)
    for value in (50.0, 51.0, 52.0):
        buffer.extend(make_full_transitions(1, value))
    assert sorted(buffer[:]["observation"][:, 0].tolist()) == [4, 50, 51, 52]


def test_rows_of_a_write_that_failed_are_not_those_of_the_next(monkeypatch):
    buffer = make_buffer(CAPACITY)
    buffer.extend(make_full_transitions(CAPACITY))
    with monkeypatch.context() as patch, pytest.raises(OSError, match="no room"):
        patch.setattr(NewRows, "write", fail_with(OSError("no room")))
        buffer.extend(make_full_transitions(1, 9.0))
    buffer.mark_update(torch.tensor([3]))
    assert buffer.rewards().tolist() == [1.0] * CAPACITY


def test_an_empty_batch_is_written_as_nothing(buffer):
    before = snapshot(buffer)
    assert buffer.extend(make_full_transitions(0)).tolist() == []
    assert same(before, snapshot(buffer))


def test_the_first_transitions_are_checked_too():
    buffer = make_buffer(CAPACITY)
    data = make_full_transitions(2)
    data["action"][1, 0] = torch.inf
    with pytest.raises(ValueError, match="'action' must be finite, got inf in row 1"):
        buffer.extend(data)
    assert len(buffer) == 0
    assert buffer.extend(make_full_transitions(2)).tolist() == [0, 1]


def test_large_numbers_whose_sum_overflows_are_no_mistake():
    buffer = make_buffer(CAPACITY)
    for _ in range(2):
        data = make_full_transitions(2)
        data["observation"] = torch.full((2, 3), 3e38)
        buffer.extend(data)
    assert len(buffer) == 4


def test_an_entry_may_be_allowed_to_hold_infinities():
    buffer = make_buffer(CAPACITY, allow_nonfinite=["ranges", ("next", "ranges")])
    for _ in range(2):
        data = make_full_transitions(2)
        data["ranges"] = torch.full((2, 5), torch.inf)
        data["next", "ranges"] = torch.full((2, 5), torch.nan)
        buffer.extend(data)
    assert buffer[:]["ranges"].isinf().all()
    buffer.load_state_dict(buffer.state_dict())


def test_transitions_with_gradients_are_stored_without():
    buffer = make_buffer(CAPACITY)
    for _ in range(2):
        data = make_full_transitions(2)
        data["action"] = data["action"].requires_grad_()
        buffer.extend(data)
    assert not buffer.sample()["action"].requires_grad


FIRST = {
    "several numbers": torch.ones(2, 3),
    "too few": torch.ones(2, 0),
    "not finite": torch.tensor([1.0, torch.inf]),
    "as high as they can be": torch.tensor([1e308, 1.0], dtype=torch.double),
}


@pytest.mark.parametrize("name", FIRST)
@pytest.mark.parametrize("fuses", [True, False])
def test_first_priorities_that_cannot_be_are_rejected_before_anything_is_stored(name, fuses):
    alpha = {"alpha": 1.0} if "high" in name else {}
    sampler = MPFASampler(CAPACITY, **alpha) if fuses else TreeSampler(CAPACITY, 1.0, 0.4)
    buffer = make_buffer(CAPACITY, sampler=sampler)
    buffer.extend(make_full_transitions(3))
    rows = make_full_transitions(2)
    rows["td_error"] = FIRST[name]
    with rejected(buffer, (ValueError, RuntimeError)):
        buffer.extend(rows)
    assert len(buffer) == 3


@pytest.mark.parametrize(("kind", "shape"), [(torch.float64, (2,)), (torch.bool, (2, 1))])
def test_first_priorities_of_any_real_type_are_taken(kind, shape):
    buffer = make_buffer(CAPACITY)
    rows = make_full_transitions(2)
    rows["td_error"] = torch.tensor([1, 0]).reshape(shape).to(kind)
    for _ in range(2):
        buffer.extend(rows)
    assert buffer.sampler.priorities()[:4].tolist() == pytest.approx([1.05, 0.05] * 2)


@pytest.mark.parametrize("shape", [(), (4,)])
def test_steps_without_all_dimensions_are_rejected_with_a_hint_to_add(shape):
    ndim = len(shape) + 1
    storage = SignalTensorStorage(CAPACITY, ndim=ndim)
    buffer = make_buffer(CAPACITY, storage=storage)
    rows = make_full_transitions(4)
    rows = rows[0] if shape == () else rows
    with pytest.raises(ValueError, match=r"tensordicts must have a batch size .* by add"):
        buffer.extend(rows)
    buffer.add(rows)
    assert len(buffer) == (shape or (1,))[0]


@pytest.mark.parametrize("part", ["construction", "first write", "update", "load"])
def test_buffer_works_outside_of_inference_mode_after_use_inside(part):
    def make():
        buffer = make_buffer(CAPACITY)
        buffer.append_transform(MultiStepTransform(n_steps=2, gamma=1.0, done_keys=["done"]))
        return buffer

    with torch.inference_mode(part == "construction"):
        buffer = make()
    with torch.inference_mode(part == "first write"):
        buffer.extend(make_full_transitions(6))
    with torch.inference_mode(part == "update"):
        train_rounds(buffer, 2)
    with torch.inference_mode(part == "load"):
        again, state = make(), snapshot(buffer)
        # In both, so that steps that wait in the transform are lost in both.
        for each in (buffer, again):
            each.load_state_dict(state)
    for each in (buffer, again):
        each.extend(make_full_transitions(5, 3.0))
    assert torch.equal(train_rounds(buffer, 3), train_rounds(again, 3))


ENDS = [torch.uint8, torch.int64, torch.float32, torch.float64]


@pytest.mark.parametrize(
    ("kind", "method"), [*zip(ENDS, ["slices", "reaper", "her", "n-step"], strict=True)]
)
def test_ends_as_numbers_are_booleans_and_other_numbers_are_rejected_by_name(kind, method):
    def make():
        names = ("td_error",)
        sampler = SignalSliceSampler(CAPACITY, 0.6, 0.4, slice_len=2, signals=names)
        if method == "reaper":
            sampler = ReaPERSampler(CAPACITY, 0.6, 0.4, signals=names)
        elif method != "slices":
            sampler = MPFASampler(CAPACITY, signals=names, fusion=FixedFusion({"td_error": 1.0}))
        storage = SignalTensorStorage(CAPACITY)
        buffer = make_buffer(CAPACITY, storage=storage, sampler=sampler)
        if method == "her":
            buffer.append_transform(HindsightGoals(Nothing(), goals=1, generator=seeded()))
        if method == "n-step":
            buffer.append_transform(MultiStepTransform(2, 1.0, done_keys=["done"]))
        return buffer

    rows = make_full_transitions(6)
    rows["episode"] = torch.arange(6).unsqueeze(1) // 3
    rows["observation"] = rows["next", "observation"] = torch.zeros(6, 3)
    rows["next", "done"][2] = True
    plain, numbers, wrong = make(), make(), make()
    plain.extend(rows)
    as_numbers = rows.clone()
    as_numbers["next", "done"] = rows["next", "done"].to(kind)
    numbers.extend(as_numbers)
    assert len(plain) == len(numbers)
    for each in (plain, numbers):
        each.update_priority(torch.arange(len(each)), torch.linspace(1, 2, len(each)))
    weights = [each.sampler.batch_weights(len(each)) for each in (plain, numbers)]
    assert same(*weights)
    as_numbers["next", "done"] = as_numbers["next", "done"] * 2
    with rejected(wrong, ValueError, r"'done'.* must be booleans, or 0 and 1, got 2"):
        wrong.extend(as_numbers)
    assert len(wrong) == 0


def steps(lengths, *, first=1.0):
    """Trajectories of these lengths, one after the other, with steps numbered from the first."""
    count = sum(lengths)
    number = torch.arange(first, first + count).unsqueeze(1)
    ends = torch.zeros(count, 1, dtype=torch.bool)
    ends[torch.tensor(lengths).cumsum(0) - 1] = True
    ids = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    after = {"observation": number + 1, "reward": number, "done": ends, "terminated": ends.clone()}
    rows = {"observation": number, "next": after, "collector": {"traj_ids": ids}}
    return TensorDict(rows, [count])


def padded(lengths, *, prefix="collector", **kwargs):
    """The same, as TorchRL's collectors with ``split_trajs`` give them."""
    found = split_trajectories(steps(lengths, **kwargs), trajectory_key=("collector", "traj_ids"))
    mask = found.pop(("collector", "mask"), None)
    mask = found.pop("mask") if mask is None else mask
    key = (prefix, "mask") if prefix else "mask"
    return found.set(key, mask)


def stored(buffer):
    return buffer[:]["observation"].flatten().tolist()


@pytest.mark.parametrize("prefix", ["collector", ""])
def test_padding_of_split_trajectories_is_left_out(prefix):
    buffer = make_buffer(batch_size=8)
    index = buffer.extend(padded([2, 4, 1], prefix=prefix))
    assert index.tolist() == list(range(7))
    assert stored(buffer) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    # The next ones may have no padding at all.
    buffer.extend(padded([3, 3], prefix=prefix, first=8.0))
    assert stored(buffer) == [float(number) for number in range(1, 14)]


def test_a_single_step_of_padding_is_not_added():
    buffer = make_buffer()
    rows = padded([2, 1])
    assert buffer.add(rows[1, 1]).numel() == 0
    assert len(buffer) == 0
    assert buffer.add(rows[1, 0]) == 0


def test_slices_of_padded_trajectories_have_no_step_of_another_one():
    sampler = SignalSliceSampler(32, 0.6, 0.4, slice_len=3, signals=["reward"])
    buffer = make_buffer(32, 30, sampler=sampler)
    buffer.extend(padded([3, 5, 4]))
    slices = buffer.sample().reshape(10, 3)
    assert slices["observation"].diff(dim=1).unique().tolist() == [1.0]
    assert (slices["collector", "traj_ids"].diff(dim=1) == 0).all()


def test_mask_of_ones_own_is_data():
    buffer = make_buffer()
    rows = steps([4]).set("mask", torch.tensor([[True], [False], [True], [False]]))
    buffer.extend(rows)
    assert stored(buffer) == [1.0, 2.0, 3.0, 4.0]


def of_two_dimensions():
    return make_buffer(16, storage=SignalTensorStorage(16, ndim=2))


def with_hindsight():
    goals = HindsightGoals(lambda rows, goals: rows, episode_key="episode")
    return make_buffer(32, transform=goals)


def with_steps():
    return make_buffer(32, transform=MultiStepTransform(n_steps=2, gamma=0.9, done_keys=["done"]))


def test_trajectories_of_one_length_have_no_padding_in_two_dimensions():
    buffer = of_two_dimensions()
    assert len(buffer.extend(padded([3, 3]))) == 6


@pytest.mark.parametrize("make", [of_two_dimensions, with_hindsight, with_steps])
def test_padding_that_cannot_be_left_out_is_rejected_and_changes_nothing(make):
    buffer = make()
    with pytest.raises(ValueError, match=r"padding, which \('collector', 'mask'\) marks"):
        buffer.extend(padded([2, 4]))
    assert len(buffer) == 0
