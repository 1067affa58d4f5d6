"""Saved samplers: what does not fit is rejected by name, before anything changes."""

import copy
import pickle

import pytest
import torch

from tests.methods.replays import make_transitions, seeded
from tests.mpfa.transitions import rejected, restore, same
from torchrl_mpfa import MPFASampler, SignalMemmapStorage, make_actor
from torchrl_mpfa.methods import METHODS as ALL
from torchrl_mpfa.methods import make_replay
from torchrl_mpfa.samplers import TreeSampler

METHODS = ["mpfa_per", "rank_per", "mw", "la3p", "cer", "geometric"]


def make_trained(name, *, seed=0, capacity=12):
    own = {"replay_cap": 2} if name == "mw" else {}
    replay = make_replay(name, capacity=capacity, batch_size=4, generator=seeded(seed), **own)
    replay.buffer.extend(make_transitions(9, seed=seed))
    for _ in range(4):
        for draw in replay.select(replay.buffer):
            if replay.signals and draw.gives_signals:
                for name in replay.signals:
                    values = torch.rand(len(draw.batch), generator=seeded(seed))
                    draw.batch["signals", name] = values
                replay.buffer.update_tensordict_priority(draw.batch)
    return replay


def batches(replay):
    return torch.cat([d.batch["index"] for _ in range(5) for d in replay.select(replay.buffer)])


@pytest.mark.parametrize("way", ["state", "folder"])
@pytest.mark.parametrize("name", METHODS)
def test_a_sampler_goes_on_as_if_nothing_had_happened(name, way, tmp_path):
    first, second = make_trained(name), make_trained(name, seed=3)
    restore(second.buffer, first.buffer, tmp_path if way == "folder" else None)
    assert same(first.buffer.sampler.state_dict(), second.buffer.sampler.state_dict())
    assert batches(first).equal(batches(second))


NOTHING = object()


def spoiled(state, name, value):
    made = dict(state)
    if value is NOTHING:
        del made[name]
    else:
        made[name] = value(state[name]) if callable(value) else value
    return made


def with_nan(tensor):
    tensor = tensor.clone()
    tensor[0] = torch.nan
    return tensor


COMMON = [
    *[
        (name, NOTHING, f"'{name}' is missing in the saved sampler")
        for name in (
            *("_alpha", "_beta", "_eps", "_max_capacity", "_highest", "_highest_slot"),
            *("_kind", "_format"),
            *("_priorities", "_learned", "_sum_tree", "_min_tree", "_signals", "_weights"),
            *("_weighed_at", "_mean_reward"),
        )
    ],
    ("_alpha", "0.6", "'_alpha' of the saved sampler must be a finite number.*got '0.6'"),
    ("_beta", torch.tensor(1.0), "'_beta' of the saved sampler must be a finite number"),
    ("_eps", -1.0, "'_eps' of the saved sampler must be"),
    ("_highest", float("nan"), "'_highest' of the saved sampler must be a finite number"),
    ("_highest_slot", 12, "'_highest_slot' of the saved sampler must be"),
    (
        "_max_capacity",
        10**18,
        "'_max_capacity' of the saved sampler must be 12, got 1000000000000000000",
    ),
    ("_sum_tree", with_nan, "'_sum_tree' .*, as follows from '_priorities', got nan"),
    ("_min_tree", with_nan, "'_min_tree' .*, as follows from '_priorities', got nan"),
    ("_sum_tree", torch.zeros_like, "'_sum_tree' .*, as follows from '_priorities', got 0.0"),
    ("_sum_tree", lambda t: t * 1.001, "'_sum_tree' .*, as follows from '_priorities', got"),
    ("_min_tree", lambda t: t.where(t.isinf(), t * 100), "'_min_tree' .*, as follows from '_prior"),
    ("_priorities", lambda t: t * 2 + 1, "_tree' .*, as follows from '_priorities', got"),
    ("_sum_tree", lambda t: t[:3], r"'_sum_tree' .* must be torch.float64 of shape \[12\], got"),
    ("_sum_tree", lambda t: t.float(), "'_sum_tree' .*got 'torch.float32 of shape"),
    ("_sum_tree", [1.0], "'_sum_tree' of the saved sampler must be torch.float64 of shape"),
    ("_sum_tree", lambda t: t * 0 + 1e308, "'_sum_tree' .* follows from '_priorities', got 1e"),
    ("_priorities", lambda t: -t, "'_priorities' of the saved sampler must be finite and not neg"),
    ("_learned", lambda t: ~(t & False), "'_learned' of the saved sampler must be false where"),
    ("_weights", {"x": 1.0}, "'_weights' of the saved sampler must be empty, or one number"),
    ("_weighed_at", -1, "'_weighed_at' of the saved sampler must be an integer of at least 0"),
    ("_mean_reward", float("inf"), "'_mean_reward' of the saved sampler must be a finite number"),
]
OWN = [
    ("mpfa_per", "_alpha", 0.1, "'_sum_tree' .*, as follows from '_priorities', got"),
    ("rank_per", "_alpha", 0.1, "'_sum_tree' .*, as follows from '_priorities', got"),
    ("rank_per", "_order", NOTHING, "'_order' is missing"),
    ("rank_per", "_order", lambda t: t.flip(0), "'_order' of the saved sampler must be"),
    ("rank_per", "_written", "3", "'_written' of the saved sampler must be an integer"),
    ("mw", "_spent", NOTHING, "'_spent' is missing"),
    ("mw", "_spent", lambda t: t.float(), "'_spent' of the saved sampler must be torch.bool"),
    ("mw", "_spent", lambda t: ~t, "'_sum_tree' .*, as follows from '_priorities', got"),
    ("cer", "_newest", NOTHING, "'_newest' is missing"),
    ("cer", "_newest", ["0"], "'_newest' of the saved sampler must be None, or a place"),
    ("geometric", "_newest", NOTHING, "'_newest' is missing"),
    ("cer", "_newest", -3, "'_newest' of the saved sampler must be None, or a place"),
]
CASES = [(name, *case) for name in METHODS[:4] for case in COMMON] + OWN


@pytest.fixture(scope="module")
def trained():
    return {name: (make_trained(name), make_trained(name, seed=3)) for name in METHODS}


@pytest.mark.parametrize(("method", "name", "value", "message"), CASES)
def test_a_state_that_does_not_fit_is_rejected_and_changes_nothing(
    trained, method, name, value, message
):
    first, second = (replay.buffer.sampler for replay in trained[method])
    with rejected(second, ValueError, message):
        second.load_state_dict(spoiled(first.state_dict(), name, value))


@pytest.mark.parametrize("method", METHODS[:4])
def test_a_state_of_another_sampler_is_rejected(trained, method):
    for other in METHODS[:4]:
        if other == method:
            continue
        first, second = trained[other][0].buffer.sampler, trained[method][1].buffer.sampler
        with rejected(second, ValueError, r"'_(kind|signals)' of the saved sampler must be"):
            second.load_state_dict(first.state_dict())
    with pytest.raises(ValueError, match="the saved sampler must be a mapping, got list"):
        second.load_state_dict([1])


@pytest.mark.parametrize(
    ("mine", "theirs", "message"),
    [
        (TreeSampler, MPFASampler, "'_kind' .* must be 'proportional', got 'signals'"),
        (MPFASampler, TreeSampler, "'_kind' .* must be 'signals', got 'proportional'"),
    ],
)
def test_a_sampler_of_one_priority_and_one_of_signals_reject_each_others_state(
    mine, theirs, message
):
    sampler = mine(12, 0.6, 0.4)
    with rejected(sampler, ValueError, message):
        sampler.load_state_dict(theirs(12, 0.6, 0.4).state_dict())


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("ddpg", "the saved sampler is 'signals', this one a RandomSampler"),
        ("cer", "'_newest' is missing in the saved sampler"),
    ],
)
def test_a_uniform_buffer_rejects_the_state_of_a_prioritized_one(method, message):
    first, second = make_trained("mpfa_per"), make_trained(method, seed=3)
    with rejected(second.buffer, ValueError, message):
        second.buffer.load_state_dict(first.buffer.state_dict())


@pytest.mark.parametrize("way", [copy.deepcopy, lambda replay: pickle.loads(pickle.dumps(replay))])
@pytest.mark.parametrize("name", ALL)
def test_the_replay_of_every_method_is_pickled_and_copied(name, way):
    actor = make_actor(3, 2, width=8)
    more = {"klper": {"policy": actor, "sigma": 0.2}, "ref_er": {"policy": actor}}.get(name, {})
    replay = make_replay(name, capacity=16, batch_size=4, generator=seeded(), **more)
    rows = make_transitions(12)
    rows["observation"] = torch.rand(12, 3, generator=seeded(1))
    rows["action"] = rows["behavior_mean"] = torch.rand(12, 2, generator=seeded(2))
    rows["behavior_sigma"] = torch.full((12, 1), 0.3)
    rows["episode"], rows["next", "done"] = torch.zeros(2, 12, 1).long()
    replay.buffer.extend(rows)
    again = way(replay)
    assert batches(replay).equal(batches(again))


def test_the_replay_of_a_method_with_a_memory_mapped_storage_is_copied():
    replay = make_replay("per", storage=SignalMemmapStorage(16, signals=["td_error"]), batch_size=4)
    replay.buffer.extend(make_transitions(12))
    again = copy.deepcopy(replay)
    assert batches(replay).equal(batches(again))
