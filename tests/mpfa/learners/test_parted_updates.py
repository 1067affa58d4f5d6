"""Updates of the critics or of the actor alone: what moves, what does not, and what is written."""

from copy import deepcopy

import pytest
import torch

from tests.mpfa import learning
from tests.mpfa.learning import UNTRACED, make_batch
from tests.mpfa.transitions import same
from torchrl_mpfa.selection import SampledBatch

RADAM = {"optimizer": "radam"}
LEARNERS = [("ddpg", {}), ("td3", {}), ("sac", {}), ("ddpg", UNTRACED), ("td3", UNTRACED)]
LEARNERS += [("ddpg", RADAM), ("sac", RADAM)]
IDS = ["ddpg", "td3", "sac", "ddpg pure", "td3 pure", "ddpg radam", "sac radam"]


def make_learner(name, seed=0, **options):
    return learning.make_learner(name, seed, **{"critic_weight_decay": 0.1, **options})


def parts(learner):
    """Copies of all that an update can move: weights and optimizer states by owner, targets."""
    networks = learner.networks
    found = {"targets": {n: v.clone() for n, v in learner.targets.named_parameters()}}
    owners = {name: [*networks[name].parameters()] for name in ("actor", "critics")}
    owners["critic"] = owners.pop("critics")
    if "temperature" in networks:
        owners["actor"] += networks["temperature"].parameters()
    for owner, parameters in owners.items():
        state = [deepcopy(dict(learner.optimizer.state.get(p, {}))) for p in parameters]
        found[owner] = {
            "weights": {str(i): p.detach().clone() for i, p in enumerate(parameters)},
            "state": {f"{i}/{k}": v for i, s in enumerate(state) for k, v in s.items()},
        }
    return found


def after_some_updates(name, **options):
    """A learner of whose every parameter the optimizer has a state, an actor's step being due."""
    learner = make_learner(name, **options)
    for seed in range(4):
        learner.update(make_batch(seed=seed))
    return learner


@pytest.mark.parametrize("fresh", [True, False], ids=["first", "later"])
@pytest.mark.parametrize(("name", "options"), LEARNERS, ids=IDS)
def test_update_of_the_critics_alone_leaves_actor_and_targets_to_the_bit(name, options, fresh):
    learner = make_learner(name, **options) if fresh else after_some_updates(name, **options)
    before, batch = parts(learner), make_batch(seed=7)
    log = learner.update(SampledBatch(batch, trains="critic", new_step=False))
    after = parts(learner)
    assert same(after["actor"], before["actor"])
    assert same(after["targets"], before["targets"])
    for key, value in after["critic"]["weights"].items():
        assert not value.equal(before["critic"]["weights"][key])
    assert {key for key in log if key.startswith("loss")} == {"loss_value"}
    assert set(batch["signals"].keys()) == {"td_error", "action_gradient"}


@pytest.mark.parametrize("fresh", [True, False], ids=["first", "later"])
@pytest.mark.parametrize(("name", "options"), LEARNERS, ids=IDS)
def test_update_of_the_actor_alone_leaves_the_critics_to_the_bit(name, options, fresh):
    learner = make_learner(name, **options) if fresh else after_some_updates(name, **options)
    before, batch = parts(learner), make_batch(seed=7)
    entries = set(batch.keys(True, True))
    log = learner.update(SampledBatch(batch, trains="actor", new_step=False))
    after = parts(learner)
    # The decay of their weights must not move them, nor the averages of Adam.
    assert same(after["critic"], before["critic"])
    assert not same(after["actor"]["weights"], before["actor"]["weights"])
    # At first the targets are the critics, and SAC has no others.
    assert same(after["targets"], before["targets"]) == (fresh and name == "sac")
    assert "loss_value" not in log
    assert "loss_actor" in log
    assert set(batch.keys(True, True)) == entries


@pytest.mark.parametrize(
    ("name", "options"), [("ddpg", {}), ("td3", {}), ("ddpg", UNTRACED), ("td3", UNTRACED)], ids=str
)
def test_actor_moves_as_in_an_update_of_both(name, options):
    """All gradients of an update are taken at the same networks, so that its halves are alike."""
    both, alone = (after_some_updates(name, **options) for _ in range(2))
    for learner, trains in ((both, "both"), (alone, "actor")):
        learner.update(SampledBatch(make_batch(seed=7), trains=trains, new_step=False))
    found, expected = (parts(learner)["actor"]["weights"] for learner in (alone, both))
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("name", ["ddpg", "td3"])
@pytest.mark.parametrize("options", [{}, UNTRACED], ids=["plain", "pure"])
def test_delayed_actor_waits_for_its_training_step_whichever_batch_it_is_in(name, options):
    delay = {"policy_delay": 2} if name == "ddpg" else {}  # TD3's is two.
    learner = make_learner(name, **delay, **options)
    step = (("both", True), ("critic", False), ("actor", False))
    found = []
    for number in range(4):
        for trains, new in step:
            before = parts(learner)
            log = learner.update(SampledBatch(make_batch(seed=number), trains=trains, new_step=new))
            after = parts(learner)
            moved = [not same(after[p], before[p]) for p in ("critic", "actor", "targets")]
            found.append((*moved, "loss_value" in log, "loss_actor" in log))
        assert learner.updates == number + 1
    critic_alone, nothing = (True, False, False, True, False), (False,) * 5
    both, actor_alone = (True,) * 5, (False, True, True, False, True)
    waiting = [critic_alone, critic_alone, nothing]
    assert found == [*waiting, both, critic_alone, actor_alone] * 2


def test_actors_batch_that_begins_a_step_counts_even_if_nothing_is_due():
    learner = make_learner("td3", policy_delay=2)
    assert learner.update(SampledBatch(make_batch(), trains="actor")) == {}
    assert "loss_actor" in learner.update(SampledBatch(make_batch(), trains="actor"))
    assert learner.updates == 2


def train(learner, steps, begin=0):
    """Updates in the order of LA3P."""
    for number in range(begin, begin + steps):
        torch.manual_seed(number)
        for place, (trains, distance) in enumerate(
            (("both", "pal"), ("critic", "smooth_l1"), ("actor", None))
        ):
            batch = make_batch(seed=3 * number + place)
            learner.update(SampledBatch(batch, trains, distance, new_step=place == 0))


@pytest.mark.parametrize(("name", "options"), LEARNERS, ids=IDS)
def test_learner_loaded_in_the_middle_of_a_step_learns_like_the_saved_one(name, options):
    first, second = make_learner(name, **options), make_learner(name, seed=1, **options)
    train(first, 3)
    train(second, 1)
    for trains in ("both", "critic"):
        first.update(SampledBatch(make_batch(seed=30), trains, new_step=trains == "both"))
    second.load_state_dict(first.state_dict())
    for learner in (first, second):
        torch.manual_seed(5)
        learner.update(SampledBatch(make_batch(seed=31), "actor", new_step=False))
        train(learner, 2, begin=9)
    assert same(first.state_dict(), second.state_dict())
