"""What learners refuse, and that nothing of them has changed by then."""

import re
from copy import deepcopy

import pytest
import torch

from tests.mpfa import sac_networks
from tests.mpfa.losses import BOUNDS, make_batch, make_networks
from tests.mpfa.transitions import same
from torchrl_mpfa import (
    DDPGLearner,
    DQNLearner,
    SACLearner,
    SignalDQNLoss,
    TD3Learner,
    make_ddpg_loss,
    make_sac_loss,
    make_td3_loss,
    make_value_network,
)
from torchrl_mpfa.selection import SampledBatch

TRACED = {"compile": {"backend": "eager"}}
# The function itself: what is traced is refused by the same lines, which one test says.
UNTRACED = {"compile": {"disable": True}}


def make_learner(name, seed=0, **options):
    """A learner after some updates, so that its optimizer has a state."""
    if name == "sac":
        learner = SACLearner(make_sac_loss(*sac_networks.make_networks(seed)), **options)
    elif name == "td3":
        loss = make_td3_loss(*make_networks(seed), bounds=BOUNDS)
        learner = TD3Learner(loss, **options)
    else:
        learner = DDPGLearner(make_ddpg_loss(*make_networks(seed)), **options)
    for step in range(3):
        learner.update(make_batch(seed=step))
    return learner


# Of the compiled learners one: what they refuse, they refuse in the same lines.
ALL = [("ddpg", {}), ("td3", {}), ("sac", {}), ("ddpg", UNTRACED)]
IDS = ["ddpg", "td3", "sac", "ddpg at once"]


def spoiled(entry, value=float("nan")):
    batch = make_batch()
    batch[entry][4] = value
    return batch


def snapshot(learner):
    return deepcopy(learner.state_dict())


@pytest.mark.parametrize(
    ("name", "options"),
    [*ALL, pytest.param("ddpg", TRACED, marks=pytest.mark.slow)],
    ids=[*IDS, "ddpg traced"],
)
def test_a_batch_with_a_number_that_is_none_changes_nothing_and_is_named(name, options):
    learner = make_learner(name, **options)
    before = snapshot(learner)
    for entry in ("observation", "action", ("next", "reward"), ("next", "observation")):
        words = re.escape(f"batch must be finite, got nan in {entry!r}, row 4")
        with pytest.raises(ValueError, match=words):
            learner.update(spoiled(entry))
        assert same(snapshot(learner), before)


def test_after_a_refused_batch_the_next_one_gives_what_it_would_have_given():
    learner, other = make_learner("ddpg"), make_learner("ddpg")
    with pytest.raises(ValueError, match="batch must be finite"):
        learner.update(spoiled("observation"))
    for each in (learner, other):
        each.update(make_batch(seed=7))
    assert same(snapshot(learner), snapshot(other))


@pytest.mark.parametrize(("name", "options"), ALL, ids=IDS)
@pytest.mark.parametrize("trains", ["critic", "actor"])
def test_a_batch_for_one_of_them_alone_is_refused_alike(name, options, trains):
    learner = make_learner(name, **options)
    before = snapshot(learner)
    draw = SampledBatch(spoiled("observation", float("inf")), trains=trains)
    with pytest.raises(ValueError, match="batch must be finite, got inf in 'observation'"):
        learner.update(draw)
    assert same(snapshot(learner), before)


@pytest.mark.parametrize("trains", ["critics", "", None, ["actor"]])
def test_a_draw_for_whom_there_is_not_is_refused(trains):
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


def test_moments_that_cannot_be_are_refused():
    learner = make_learner("ddpg")
    state = deepcopy(learner.state_dict())
    state["optimizer"]["state"][0]["exp_avg_sq"].view(-1)[0] = -1.0
    with pytest.raises(ValueError, match=r"'exp_avg_sq' .* must be finite and not neg.* -1.0"):
        learner.load_state_dict(state)


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
    learner = DQNLearner(SignalDQNLoss(make_value_network(9, 4, width=8)))
    batch = make_batch()
    batch["action"] = torch.eye(4)[torch.zeros(len(batch), dtype=torch.long)]
    with pytest.raises(RuntimeError, match=r"batch does not fit the loss, got 'observation' \["):
        learner.update(batch)


def test_rewards_that_overflow_the_loss_are_told_from_rewards_that_are_none():
    learner = make_learner("ddpg")
    before = snapshot(learner)
    with pytest.raises(ValueError, match="loss_value must be finite, got inf of a finite batch"):
        learner.update(spoiled(("next", "reward"), 1e30))
    assert same(snapshot(learner), before)


def altered(state, path, value):
    """A copy of a state in which one entry has another value, or is missing."""
    state = deepcopy(state)
    at = state
    for key in path[:-1]:
        at = at[key]
    if value is None:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return state


def weight_of(state, start="target_"):
    """Name of the first matrix among the entries of the loss."""
    entries = state["loss"].items()
    return next(n for n, v in entries if n.startswith(start) and getattr(v, "ndim", 0) >= 2)


@pytest.mark.parametrize("name", ["ddpg", "sac"])
@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (["optimizer"], None, "'optimizer' is missing in the saved learner"),
        (["loss"], None, "'loss' is missing in the saved learner"),
        (["updates"], None, "'updates' is missing in the saved learner"),
        (["updates"], "3", "'updates' of the saved learner must be an integer .*, got '3'"),
        (["updates"], -1, "'updates' of the saved learner must be an integer .*, got -1"),
        (["optimizer"], [], "the saved optimizer must be a mapping, got list"),
        (["optimizer", "state"], None, "'state' is missing in the saved optimizer"),
        (["optimizer", "state", 0], [], "the saved moments of parameter 0 must be a mapping"),
        (["optimizer", "state", 0, "exp_avg"], None, "'exp_avg' is missing in the saved moments"),
        (
            ["optimizer", "state", 0, "exp_avg"],
            torch.zeros(1),
            r"'exp_avg' of the saved moments of parameter 0 must be .* got .* of shape \[1\]",
        ),
        (["optimizer", "state"], {}, "'state' .* must be .*not empty after 3 updates"),
        (
            ["optimizer", "state", 0, "step"],
            torch.tensor(-5.0),
            "'step' of the saved moments .* must be finite and not negative, got -5.0",
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
        (["optimizer", "param_groups", 0, "lr"], None, "'lr' is missing .* group 0"),
        (["optimizer", "param_groups", 0, "params"], [0], r"'params' .* must be \[0, 1"),
        (["loss", "other"], torch.zeros(1), "the saved loss has 'other', unlike"),
        (["loss", "WEIGHT"], None, "'target_.* is missing in the saved loss"),
        (["loss", "WEIGHT"], torch.zeros(3), r"must be .* of shape .*, got .* of shape \[3\]"),
        (["loss", "WEIGHT"], "text", "must be torch.float32 of shape .*, got 'text'"),
        (["loss", "WEIGHT"], torch.nan, "must be finite, got nan"),
    ],
    ids=str,
)
def test_a_foreign_state_changes_nothing_and_is_named(name, path, value, words):
    learner, other = make_learner(name), make_learner(name, seed=1)
    state = other.state_dict()
    if path[-1] == "WEIGHT":
        key = weight_of(state)
        path = [*path[:-1], key]
        if value is torch.nan:
            value = torch.full_like(state["loss"][key], torch.nan)
    before = snapshot(learner)
    with pytest.raises((TypeError, ValueError), match=words):
        learner.load_state_dict(altered(state, path, value))
    assert same(snapshot(learner), before)
    learner.load_state_dict(state)
    assert same(snapshot(learner), snapshot(other))


def test_the_state_of_another_kind_or_size_is_refused():
    learner = make_learner("ddpg")
    before = snapshot(learner)
    for other in ("td3", "sac"):
        with pytest.raises(ValueError, match=r"missing in the saved loss|the saved loss has"):
            learner.load_state_dict(make_learner(other).state_dict())
    wide = DDPGLearner(make_ddpg_loss(*make_networks(width=32)))
    with pytest.raises(
        ValueError, match=r"must be torch.float32 of shape .*, got 'torch.float32 of shape"
    ):
        learner.load_state_dict(wide.state_dict())
    for wrong in (None, 3, "state"):
        with pytest.raises(ValueError, match="the saved learner must be a mapping"):
            learner.load_state_dict(wrong)
    assert same(snapshot(learner), before)


@pytest.mark.parametrize(
    ("kind", "name"), [(DDPGLearner, "td3"), (TD3Learner, "sac"), (SACLearner, "ddpg")]
)
def test_a_loss_of_another_learner_is_refused_by_both_names(kind, name):
    loss = make_learner(name).loss
    expected = kind.loss_type.__name__
    words = f"loss of a {kind.__name__} must be a {expected}, got {type(loss).__name__}"
    with pytest.raises(TypeError, match=words):
        kind(loss)


def test_a_loss_that_is_not_reduced_is_refused():
    loss = make_ddpg_loss(*make_networks(), reduction="none")
    with pytest.raises(ValueError, match="reduction of the loss must be 'mean' or 'sum'"):
        DDPGLearner(loss)
    DDPGLearner(make_ddpg_loss(*make_networks(), reduction="sum")).update(make_batch())


@pytest.mark.parametrize("name", ["actor_lr", "critic_lr", "critic_weight_decay", "tau"])
def test_rates_that_are_no_numbers_are_refused(name):
    for value in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"{name} must .*got {value}"):
            make_learner("td3", **{name: value})


@pytest.mark.parametrize("name", ["ddpg", "td3", "sac"])
def test_the_defaults_are_those_of_table_1_and_a_light_decay(name):
    groups = make_learner(name).optimizer.param_groups
    assert [group["lr"] for group in groups[:2]] == [1e-4, 1e-4]
    assert [group["weight_decay"] for group in groups[:2]] == [0.0, 1e-4]


@pytest.mark.parametrize(("name", "options"), ALL, ids=IDS)
def test_a_copy_which_would_not_learn_is_refused(name, options):
    learner = make_learner(name, **options)
    with pytest.raises(TypeError, match=f"a {type(learner).__name__} cannot be copied: make"):
        deepcopy(learner)


def test_a_copy_of_a_learner_of_discrete_actions_is_refused():
    with pytest.raises(TypeError, match="a DQNLearner cannot be copied: make another one"):
        deepcopy(DQNLearner(SignalDQNLoss(make_value_network(6, 4, width=8))))
