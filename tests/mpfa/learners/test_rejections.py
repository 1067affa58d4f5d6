"""Rejections by learners, and that nothing of them has changed by then."""

import math
import re
from copy import deepcopy
from functools import partial

import pytest
import torch

from tests.mpfa import learning
from tests.mpfa.learning import KINDS, TRACED, UNTRACED, make_batch, make_discrete, make_networks
from tests.mpfa.transitions import MISSING, rejected, same, snapshot, spoil
from torchrl_mpfa.selection import SampledBatch

# Of the compiled learners one: what they reject, they reject in the same lines.
ALL = [*((kind, {}) for kind in KINDS), ("ddpg", UNTRACED)]
IDS = [*KINDS, "ddpg at once"]


def make_learner(name, seed=0, *, updates=3, **options):
    """A learner after some updates, so that its optimizer has a state."""
    learner = learning.make_learner(name, seed, **options)
    for step in range(updates):
        learner.update(make_batch(seed=step))
    return learner


def spoiled(entry, value=float("nan")):
    batch = make_batch()
    batch[entry][4] = value
    return batch


@pytest.mark.parametrize(
    ("name", "options"),
    [*ALL, pytest.param("ddpg", TRACED, marks=pytest.mark.slow)],
    ids=[*IDS, "ddpg traced"],
)
@pytest.mark.parametrize("updates", [0, 3])
def test_batch_with_nan_changes_nothing_and_its_entry_is_named(name, options, updates):
    learner = make_learner(name, updates=updates, **options)
    before = snapshot(learner)
    for entry in ("observation", "action", ("next", "reward"), ("next", "observation")):
        words = re.escape(f"batch must be finite, got nan in {entry!r}, row 4")
        with pytest.raises(ValueError, match=words):
            learner.update(spoiled(entry))
        assert same(snapshot(learner), before)


@pytest.mark.parametrize(("name", "options"), ALL, ids=IDS)
@pytest.mark.parametrize("trains", ["critic", "actor"])
def test_batch_with_infinity_for_critic_or_actor_alone_is_rejected(name, options, trains):
    learner = make_learner(name, **options)
    batch = SampledBatch(spoiled("observation", float("inf")), trains=trains)
    with rejected(learner, ValueError, "batch must be finite, got inf in 'observation'"):
        learner.update(batch)


@pytest.mark.parametrize("trains", ["critics", "", None, ["actor"]])
def test_batch_for_an_unknown_network_is_rejected(trains):
    words = re.escape(f"trains must be one of ('both', 'critic', 'actor'), got {trains!r}")
    with pytest.raises(ValueError, match=words):
        SampledBatch(make_batch(), trains=trains)


@pytest.mark.parametrize(("name", "options"), ALL, ids=IDS)
def test_batch_without_an_entry_changes_nothing(name, options):
    learner = make_learner(name, **options)
    before = snapshot(learner)
    for entry in ("observation", "action", "next", ("next", "reward"), ("next", "terminated")):
        with pytest.raises(KeyError, match=entry if isinstance(entry, str) else entry[-1]):
            learner.update(make_batch().exclude(entry))
        assert same(snapshot(learner), before)


@pytest.mark.parametrize(("name", "options"), ALL, ids=IDS)
@pytest.mark.parametrize("entry", ["observation", "action", ("next", "observation")])
def test_batch_that_does_not_fit_the_networks_is_named_and_changes_nothing(name, options, entry):
    learner, batch = make_learner(name, **options), make_batch()
    before = snapshot(learner)
    for wrong in (torch.cat([batch[entry]] * 2, -1), batch[entry].double()):
        words = re.escape(f"{entry!r} {[*wrong.shape]} {wrong.dtype}")
        with pytest.raises(RuntimeError, match=f"batch does not fit the loss, got .*{words}.*:"):
            learner.update(make_batch().set(entry, wrong))
        assert same(snapshot(learner), before)


def test_batch_that_does_not_fit_a_network_of_discrete_actions_is_named():
    learner, batch = make_discrete(9), make_batch()
    batch["action"] = torch.eye(4)[torch.zeros(len(batch), dtype=torch.long)]
    with pytest.raises(RuntimeError, match=r"batch does not fit the loss, got 'observation' \["):
        learner.update(batch)


def test_loss_that_overflows_is_rejected_as_a_loss_and_not_as_a_batch():
    learner = make_learner("ddpg")
    with rejected(learner, ValueError, "loss_value must be finite, got inf of a finite batch"):
        learner.update(spoiled(("next", "reward"), 1e30))


def weight_of(learner):
    """Name of the first matrix among the targets."""
    entries = learner.state_dict()["targets"].items()
    return next(name for name, value in entries if value.ndim >= 2)


def entry_of(state, path):
    for key in path:
        state = state[key]
    return state


SPOILED = object()
"""In place of a tensor of which no number is finite."""
FIRST, GROUP = ["optimizer", "state", 0], ["optimizer", "param_groups", 0]


@pytest.mark.parametrize("name", ["ddpg", "sac"])
@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ([], None, "the saved learner must be .*, got None"),
        (["optimizer"], MISSING, "the saved learner lacks 'optimizer'"),
        (["loss"], {}, "the saved learner must not have 'loss'"),
        (["updates"], MISSING, "the saved learner lacks 'updates'"),
        (["updates"], "3", "the saved learner, 'updates' must be 3, got '3'"),
        (["optimizer", "state"], MISSING, "the saved learner, 'optimizer' lacks 'state'"),
        ([*FIRST, "exp_avg"], MISSING, "'optimizer', 'state', 0 lacks 'exp_avg'"),
        ([*FIRST, "exp_avg"], torch.zeros(1), r"'exp_avg' must be torch.float32 of shape .*\[1\]"),
        ([*FIRST, "exp_avg_sq"], SPOILED, "the saved learner must be finite, got nan in 'exp_a"),
        (FIRST, [], "'optimizer', 'state', 0 must be .*, got a list of 0"),
        (["optimizer", "state", 99], {}, "'optimizer', 'state' must not have 99"),
        ([*GROUP, "lr"], "1", "'param_groups', 0, 'lr' must be 0.001, got '1'"),
        ([*GROUP, "eps"], math.nan, "the saved learner must be finite, got nan in 'eps'"),
        ([*GROUP, "params"], [0], r"'params' must be a list of \d+, got a list of 1"),
        (
            ["optimizer", "param_groups"],
            [],
            r"'param_groups' must be a list of \d, got a list of 0",
        ),
        (
            ["targets", "other"],
            torch.zeros(1),
            "the saved learner, 'targets' must not have 'other'",
        ),
        (["targets", "WEIGHT"], SPOILED, "the saved learner must be finite, got nan in '"),
    ],
)
def test_foreign_state_changes_nothing_and_is_named(name, path, value, words):
    learner, other = make_learner(name), make_learner(name, seed=1)
    path = [weight_of(learner) if key == "WEIGHT" else key for key in path]
    state = other.state_dict()
    foreign = deepcopy(state)
    if value is SPOILED:
        spoil(foreign, path, torch.full_like(entry_of(foreign, path), torch.nan))
    elif path:
        spoil(foreign, path, value)
    with rejected(learner, ValueError, words):
        learner.load_state_dict(foreign if path else value)
    learner.load_state_dict(state)
    assert same(snapshot(learner), snapshot(other))


def test_state_of_another_kind_or_size_changes_nothing():
    learner = make_learner("ddpg")
    wide = learning.make_learner(networks=make_networks(width=32))
    for other in (make_learner("td3"), make_learner("sac"), wide):
        with rejected(learner, ValueError, "the saved learner, 'networks'"):
            learner.load_state_dict(other.state_dict())


@pytest.mark.parametrize("make", [*(partial(make_learner, kind) for kind in KINDS), make_discrete])
def test_several_batches_are_not_taken_for_one(make):
    learner, several = make(), SampledBatch(make_batch(), batches=2)
    with rejected(learner, ValueError, "sampled must be one batch, got 2: update by each of sampl"):
        learner.update(several)
