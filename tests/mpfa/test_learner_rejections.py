"""Rejections by learners, and that nothing of them has changed by then."""

import re
from copy import deepcopy

import pytest
import torch

from tests.mpfa import losses
from tests.mpfa.losses import KINDS, LEARNERS, TRACED, UNTRACED, make_batch, make_networks
from tests.mpfa.transitions import MISSING, rejected, same, snapshot, spoil
from torchrl_mpfa import DQNLearner, SignalDQNLoss, make_value_network
from torchrl_mpfa.selection import SampledBatch

# Of the compiled learners one: what they reject, they reject in the same lines.
ALL = [*((kind, {}) for kind in KINDS), ("ddpg", UNTRACED)]
IDS = [*KINDS, "ddpg at once"]


def make_learner(name, seed=0, *, updates=3, **options):
    """A learner after some updates, so that its optimizer has a state."""
    learner = losses.make_learner(name, seed, **options)
    for step in range(updates):
        learner.update(make_batch(seed=step))
    return learner


def make_discrete(size=5):
    return DQNLearner(SignalDQNLoss(make_value_network(size, 4, width=8)))


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
def test_a_batch_with_a_number_that_is_none_changes_nothing_and_is_named(name, options, updates):
    learner = make_learner(name, updates=updates, **options)
    before = snapshot(learner)
    for entry in ("observation", "action", ("next", "reward"), ("next", "observation")):
        words = re.escape(f"batch must be finite, got nan in {entry!r}, row 4")
        with pytest.raises(ValueError, match=words):
            learner.update(spoiled(entry))
        assert same(snapshot(learner), before)


def test_after_a_rejected_batch_the_next_one_gives_what_it_would_have():
    learner, other = make_learner("ddpg"), make_learner("ddpg")
    with pytest.raises(ValueError, match="batch must be finite"):
        learner.update(spoiled("observation"))
    for each in (learner, other):
        each.update(make_batch(seed=7))
    assert same(snapshot(learner), snapshot(other))


@pytest.mark.parametrize(("name", "options"), ALL, ids=IDS)
@pytest.mark.parametrize("trains", ["critic", "actor"])
def test_a_batch_for_one_of_them_alone_is_rejected_alike(name, options, trains):
    learner = make_learner(name, **options)
    batch = SampledBatch(spoiled("observation", float("inf")), trains=trains)
    with rejected(learner, ValueError, "batch must be finite, got inf in 'observation'"):
        learner.update(batch)


@pytest.mark.parametrize("trains", ["critics", "", None, ["actor"]])
def test_a_batch_for_a_network_that_there_is_not_is_rejected(trains):
    words = re.escape(f"trains must be one of ('both', 'critic', 'actor'), got {trains!r}")
    with pytest.raises(ValueError, match=words):
        SampledBatch(make_batch(), trains=trains)


@pytest.mark.parametrize(("name", "options"), ALL, ids=IDS)
def test_a_batch_without_an_entry_changes_nothing(name, options):
    learner = make_learner(name, **options)
    before = snapshot(learner)
    for entry in ("action", ("next", "reward"), ("next", "terminated")):
        with pytest.raises((KeyError, AttributeError, TypeError)):
            learner.update(make_batch().exclude(entry))
        assert same(snapshot(learner), before)


@pytest.mark.parametrize(("name", "options"), ALL, ids=IDS)
@pytest.mark.parametrize("entry", ["observation", "action", ("next", "observation")])
def test_a_batch_that_does_not_fit_the_networks_is_named_and_changes_nothing(name, options, entry):
    learner, batch = make_learner(name, **options), make_batch()
    before = snapshot(learner)
    for wrong in (torch.cat([batch[entry]] * 2, -1), batch[entry].double()):
        words = re.escape(f"{entry!r} {[*wrong.shape]} {wrong.dtype}")
        with pytest.raises(RuntimeError, match=f"batch does not fit the loss, got .*{words}.*:"):
            learner.update(make_batch().set(entry, wrong))
        assert same(snapshot(learner), before)


def test_a_batch_that_does_not_fit_a_network_of_discrete_actions_is_named():
    learner, batch = make_discrete(9), make_batch()
    batch["action"] = torch.eye(4)[torch.zeros(len(batch), dtype=torch.long)]
    with pytest.raises(RuntimeError, match=r"batch does not fit the loss, got 'observation' \["):
        learner.update(batch)


def test_rewards_that_overflow_the_loss_are_told_from_rewards_that_are_none():
    learner = make_learner("ddpg")
    with rejected(learner, ValueError, "loss_value must be finite, got inf of a finite batch"):
        learner.update(spoiled(("next", "reward"), 1e30))


def weight_of(state, start="target_"):
    """Name of the first matrix among the entries of the loss."""
    entries = state["loss"].items()
    return next(n for n, v in entries if n.startswith(start) and getattr(v, "ndim", 0) >= 2)


@pytest.mark.parametrize("name", ["ddpg", "sac"])
@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (["optimizer"], MISSING, "'optimizer' is missing in the saved learner"),
        (["loss"], MISSING, "'loss' is missing in the saved learner"),
        (["updates"], MISSING, "'updates' is missing in the saved learner"),
        (["updates"], "3", "'updates' of the saved learner must be an integer .*, got '3'"),
        (["updates"], -1, "'updates' of the saved learner must be an integer .*, got -1"),
        (["optimizer"], [], "the saved optimizer must be a mapping, got list"),
        (["optimizer", "state"], MISSING, "'state' is missing in the saved optimizer"),
        (
            ["optimizer", "state", 0, "exp_avg_sq"],
            torch.tensor(-1.0),
            r"'exp_avg_sq' .* must be finite and not neg.* -1.0",
        ),
        (["optimizer", "state", 0], [], "the saved moments of parameter 0 must be a mapping"),
        (
            ["optimizer", "state", 0, "exp_avg"],
            MISSING,
            "'exp_avg' is missing in the saved moments",
        ),
        (
            ["optimizer", "state", 0, "exp_avg"],
            torch.zeros(1),
            r"'exp_avg' of the saved moments of parameter 0 must be .* got .* of shape \[1\]",
        ),
        (["optimizer", "state"], {}, "'state' .* must be .*not empty after 3 updates"),
        (
            ["optimizer", "state", 0, "step"],
            torch.tensor(-5.0),
            "'step' of the saved moments .* finite and not negative, got tensor.-5",
        ),
        (
            ["optimizer", "param_groups", 0, "lr"],
            "1",
            "'lr' of the saved optimizer's group 0 must be a finite number .*, got '1'",
        ),
        (["optimizer", "param_groups", 1, "eps"], torch.nan, "'eps' .* group 1 must be .*got nan"),
        (["optimizer", "state", 99], {}, r"'state' .* must be of \d+ parameters"),
        (["optimizer", "param_groups"], [], r"'param_groups' .* must be \d groups, got \[\]"),
        (["optimizer", "param_groups"], 3, r"'param_groups' .* must be \d groups, got 3"),
        (["optimizer", "param_groups", 0, "lr"], MISSING, "'lr' is missing .* group 0"),
        (["optimizer", "param_groups", 0, "params"], [0], r"'params' .* must be \[0, 1"),
        (["loss", "other"], torch.zeros(1), "the saved loss has 'other', unlike"),
        (["loss", "WEIGHT"], MISSING, "'target_.* is missing in the saved loss"),
        (["loss", "WEIGHT"], torch.zeros(3), r"must be .* of shape .*, got .* of shape \[3\]"),
        (["loss", "WEIGHT"], "text", "must be torch.float32 of shape .*, got 'text'"),
        (["loss", "WEIGHT"], torch.nan, "must be finite, got nan"),
    ],
)
def test_a_foreign_state_changes_nothing_and_is_named(name, path, value, words):
    learner, other = make_learner(name), make_learner(name, seed=1)
    state = other.state_dict()
    if path[-1] == "WEIGHT":
        key = weight_of(state)
        path = [*path[:-1], key]
        if value is torch.nan:
            value = torch.full_like(state["loss"][key], torch.nan)
    if path[-1] == "exp_avg_sq":
        value = value.expand_as(state["optimizer"]["state"][0]["exp_avg_sq"])
    before, spoiled = snapshot(learner), deepcopy(state)
    spoil(spoiled, path, value)
    with pytest.raises((TypeError, ValueError), match=words):
        learner.load_state_dict(spoiled)
    assert same(snapshot(learner), before)
    learner.load_state_dict(state)
    assert same(snapshot(learner), snapshot(other))


def test_the_state_of_another_kind_or_size_is_rejected():
    learner = make_learner("ddpg")
    before = snapshot(learner)
    for other in ("td3", "sac"):
        with pytest.raises(ValueError, match=r"missing in the saved loss|the saved loss has"):
            learner.load_state_dict(make_learner(other).state_dict())
    wide = losses.make_learner(of_loss={"networks": make_networks(width=32)})
    with pytest.raises(
        ValueError, match=r"must be torch.float32 of shape .*, got 'torch.float32 of shape"
    ):
        learner.load_state_dict(wide.state_dict())
    for wrong in (None, 3, "state"):
        with pytest.raises(ValueError, match="the saved learner must be a mapping"):
            learner.load_state_dict(wrong)
    assert same(snapshot(learner), before)


@pytest.mark.parametrize(("kind", "name"), [("ddpg", "td3"), ("td3", "sac"), ("sac", "ddpg")])
def test_a_loss_of_another_learner_is_rejected_by_both_names(kind, name):
    loss, kind = losses.make_of(name), LEARNERS[kind]
    expected = kind.loss_type.__name__
    words = f"loss of a {kind.__name__} must be a {expected}, got {type(loss).__name__}"
    with pytest.raises(TypeError, match=words):
        kind(loss)


def test_a_loss_that_is_not_reduced_is_rejected():
    with pytest.raises(ValueError, match="reduction of the loss must be 'mean' or 'sum'"):
        losses.make_learner(of_loss={"reduction": "none"})
    losses.make_learner(of_loss={"reduction": "sum"}).update(make_batch())


NAN, INF = float("nan"), float("inf")
ARGUMENTS = [
    *((kind, "actor_lr", value) for kind in KINDS for value in (0.0, NAN, INF)),
    *(("td3", "critic_lr", value) for value in (-1.0, NAN, INF)),
    *(("ddpg", "critic_weight_decay", value) for value in (-0.1, NAN, INF)),
    *((kind, "tau", value) for kind in KINDS for value in (0.0, 1.5, NAN, INF)),
    *((kind, "policy_delay", 0) for kind in KINDS),
    ("sac", "alpha_lr", 0.0),
]


@pytest.mark.parametrize(("kind", "argument", "value"), ARGUMENTS)
def test_an_argument_out_of_its_range_is_named_with_its_value(kind, argument, value):
    with pytest.raises(ValueError, match=f"{argument} must .*got {value}"):
        losses.make_learner(kind, **{argument: value})


@pytest.mark.parametrize("name", ["ddpg", "td3", "sac"])
def test_the_defaults_are_those_of_table_1_and_a_light_decay(name):
    groups = LEARNERS[name](losses.make_of(name)).optimizer.param_groups
    assert [group["lr"] for group in groups[:2]] == [1e-4, 1e-4]
    assert [group["weight_decay"] for group in groups[:2]] == [0.0, 1e-4]


@pytest.mark.parametrize(
    "make", [*(lambda k=k: losses.make_learner(k) for k in KINDS), make_discrete]
)
def test_a_copy_which_would_not_learn_is_rejected(make):
    learner = make()
    with pytest.raises(TypeError, match=f"a {type(learner).__name__} cannot be copied: make"):
        deepcopy(learner)
