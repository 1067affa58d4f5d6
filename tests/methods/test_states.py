"""Saved samplers: a loaded one samples like the saved one, and a wrong state changes nothing."""

import copy
import pickle

import pytest
import torch

from benchmarks.paper.methods import RECONSTRUCTIONS
from tests.mpfa.transitions import MISSING, make_transitions, rejected, restore, same, seeded, spoil
from torchrl_mpfa import MPFASampler, SignalMemmapStorage, make_actor
from torchrl_mpfa.methods import METHODS as ALL
from torchrl_mpfa.methods import make_replay
from torchrl_mpfa.samplers import TreeSampler

METHODS = ["mpfa_per", "rank_per", "mw", "la3p", "cer", "geometric"]


def make_trained(name, *, seed=0, capacity=12):
    own = {"replay_cap": 2} if name == "mw" else {}
    method = RECONSTRUCTIONS.get(name, name)
    replay = make_replay(method, capacity=capacity, batch_size=4, generator=seeded(seed), **own)
    replay.buffer.extend(make_transitions(9, seed=seed))
    for _ in range(4):
        for sampled in replay.select(replay.buffer):
            if replay.signals and sampled.gives_signals:
                for name in replay.signals:
                    values = torch.rand(len(sampled.batch), generator=seeded(seed))
                    sampled.batch["signals", name] = values
                replay.buffer.update_tensordict_priority(sampled.batch)
    return replay


def batches(replay):
    return torch.cat([d.batch["index"] for _ in range(5) for d in replay.select(replay.buffer)])


@pytest.mark.parametrize("way", ["state", "folder"])
@pytest.mark.parametrize("name", METHODS)
def test_loaded_sampler_has_the_state_and_the_batches_of_the_saved_one(name, way, tmp_path):
    first, second = make_trained(name), make_trained(name, seed=3)
    restore(second.buffer, first.buffer, tmp_path if way == "folder" else None)
    assert same(first.buffer.sampler.state_dict(), second.buffer.sampler.state_dict())
    assert batches(first).equal(batches(second))


def with_nan(tensor):
    return tensor.index_fill(0, torch.tensor([0]), torch.nan)


COMMON = [
    *[
        (name, MISSING, f"'{name}' is missing in the saved sampler")
        for name in (
            *("_alpha", "_beta", "_eps", "_max_capacity", "_highest", "_highest_slot", "_kind"),
            *("_format", "_priorities", "_learned", "_sum_tree", "_signals"),
            *("_weights", "_weighed_at", "_mean_reward"),
        )
    ],
    ("_alpha", lambda _: "0.6", "alpha must be a number, got '0.6'"),
    ("_beta", torch.tensor, "'_beta' of the saved sampler must be a plain value"),
    ("_eps", lambda _: -1.0, "eps must be finite and not negative, got -1.0"),
    ("_format", lambda _: 99, "'_format' of the saved sampler must be 5, got 99"),
    ("_max_capacity", lambda _: 10**18, "'_max_capacity' of the saved sampler must be 12, got 10"),
    ("_sum_tree", with_nan, "'_sum_tree' of the saved sampler must be finite and not neg"),
    ("_sum_tree", lambda t: t[:3], r"'_sum_tree' .* must be torch.float64 of shape \[12\], got"),
    ("_sum_tree", lambda t: t.float(), r"'_sum_tree' .*got torch.float32 of shape \[12\]"),
    ("_sum_tree", lambda _: [1.0], "'_sum_tree' of the saved sampler must be torch.float64 of"),
    ("_sum_tree", lambda t: t * 0 + 1e308, "'_sum_tree' .* must have a finite sum, got inf"),
    ("_priorities", lambda t: -t, "'_priorities' of the saved sampler must be finite and not neg"),
    ("_learned", lambda t: t.int(), r"'_learned' of the saved sampler must be torch.bool"),
    ("_weights", lambda _: {"x": 1.0}, "'_weights' of the saved sampler must be of the signals"),
    ("_weights", lambda w: dict.fromkeys(w, -1.0), "'_weights' of the saved sampler must be fin"),
    ("_mean_reward", lambda _: torch.inf, "mean reward of the saved sampler must be finite"),
]
OWN = [
    ("rank_per", "_order", MISSING, "'_order' is missing"),
    ("rank_per", "_order", lambda t: t.flip(0), "'_order' of the saved sampler must be of rising"),
    ("mw", "_spent", MISSING, "'_spent' is missing"),
    ("mw", "_spent", lambda t: t.float(), "'_spent' of the saved sampler must be torch.bool"),
    ("la3p", "_sum_tree", torch.zeros_like, "'_sum_tree' of the saved sampler must be positive"),
    ("cer", "newest", MISSING, "'newest' is missing"),
    ("geometric", "newest", MISSING, "'newest' is missing"),
]
CASES = [(name, *case) for name in METHODS[:4] for case in COMMON] + OWN


@pytest.fixture(scope="module")
def trained():
    return {name: (make_trained(name), make_trained(name, seed=3)) for name in METHODS}


@pytest.mark.parametrize(("method", "name", "value", "message"), CASES)
def test_wrong_state_is_rejected_and_changes_nothing(trained, method, name, value, message):
    first, second = (replay.buffer.sampler for replay in trained[method])
    state = first.state_dict()
    spoil(state, (name,), value if value is MISSING else value(state[name]))
    attributes = dict(vars(second))
    with rejected(second, (KeyError, ValueError, TypeError), message):
        second.load_state_dict(state)
    assert all(attributes[name] is value for name, value in vars(second).items())


@pytest.mark.parametrize("method", METHODS[:4])
def test_state_of_another_method_is_rejected(trained, method):
    for other in {*METHODS[:4]} - {method}:
        first, second = trained[other][0].buffer.sampler, trained[method][1].buffer.sampler
        with rejected(second, (KeyError, ValueError), r"'_kind' of the|'_signals' of|is missing"):
            second.load_state_dict(first.state_dict())
    with pytest.raises(ValueError, match="the saved sampler must be a mapping, got list"):
        second.load_state_dict([1])


@pytest.mark.parametrize("kinds", [(TreeSampler, MPFASampler), (MPFASampler, TreeSampler)])
def test_state_of_another_kind_of_sampler_is_rejected(kinds):
    sampler, other = (kind(12, 0.6, 0.4) for kind in kinds)
    with rejected(sampler, ValueError, f"'_kind' .* must be '{sampler.KIND}', got '{other.KIND}'"):
        sampler.load_state_dict(other.state_dict())


@pytest.mark.parametrize(
    ("method", "message"),
    [("ddpg", "the saved sampler is 'signals', this one a RandomSampler"), ("cer", "newest")],
)
def test_uniform_buffer_rejects_the_state_of_a_prioritized_one(method, message):
    first, second = make_trained("mpfa_per"), make_trained(method, seed=3)
    with rejected(second.buffer, (KeyError, ValueError), message):
        second.buffer.load_state_dict(first.buffer.state_dict())


@pytest.mark.parametrize("way", [copy.deepcopy, lambda replay: pickle.loads(pickle.dumps(replay))])
@pytest.mark.parametrize("name", ALL)
def test_replay_of_every_method_is_pickled_and_copied(name, way):
    actor = make_actor(3, 2, width=8)
    more = {"ref_er": {"policy": actor}}.get(name, {})
    replay = make_replay(name, capacity=16, batch_size=4, generator=seeded(), **more)
    rows = make_transitions(12)
    rows["observation"] = torch.rand(12, 3, generator=seeded(1))
    rows["action"] = rows["behavior_mean"] = torch.rand(12, 2, generator=seeded(2))
    rows["behavior_sigma"] = torch.full((12, 1), 0.3)
    rows["episode"], rows["next", "done"] = torch.zeros(2, 12, 1).long()
    replay.buffer.extend(rows)
    again = way(replay)
    assert batches(replay).equal(batches(again))


def test_replay_with_a_memory_mapped_storage_is_copied():
    replay = make_replay("per", storage=SignalMemmapStorage(16), batch_size=4)
    replay.buffer.extend(make_transitions(12))
    again = copy.deepcopy(replay)
    assert batches(replay).equal(batches(again))
