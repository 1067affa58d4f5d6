"""ReF-ER: which transitions are far, what of them is learned, and how the policy is held."""

import math

import pytest
import torch
from tensordict import TensorDict

from tests.methods.replays import make_buffer
from tests.mpfa.learning import differentiate, make_networks
from tests.mpfa.test_updates import make_learner
from tests.mpfa.transitions import make_rows, make_transitions, restore, seeded
from torchrl_mpfa import ActorCritic, make_actor
from torchrl_mpfa.losses import trusted_loss
from torchrl_mpfa.methods import loss_options, make_replay
from torchrl_mpfa.methods.ref_er import ReFERSampler, ReFERSelection, next_weight

COUNT = 200


def density(action, mean, sigma):
    """Density of an action by a Gaussian, one dimension after the other."""
    found = 1.0
    for a, m in zip(action, mean, strict=True):
        found *= math.exp(-((a - m) ** 2) / (2 * sigma**2)) / (sigma * math.sqrt(2 * math.pi))
    return found


def random_actions(seed, count=COUNT):
    return torch.rand(count, 2, generator=seeded(seed), dtype=torch.double) * 2 - 1


def make_ref_er(learner, rows, **settings):
    replay = make_replay(
        "ref_er",
        capacity=COUNT,
        batch_size=COUNT,
        generator=seeded(0),
        policy=learner.policy,
        **settings,
    )
    replay.buffer.extend(rows)
    return replay


def rows_near_and_far(learner, shift):
    """Every other action is what the policy would do; the others are this far from it."""
    rows = make_rows(COUNT)
    with torch.no_grad():
        now = learner.policy(rows.select("observation"))["action"]
    moved = now.clone()
    moved[1::2] += shift
    rows["action"], rows["behavior_mean"] = moved, moved.clone()
    return rows


@pytest.mark.parametrize("batches", [0, 4_000_000])
def test_near_transitions_have_ratios_within_the_limit_and_noise_of_at_least_a_fifth(batches):
    learner = make_learner(**loss_options("ref_er"))
    rows = make_rows(COUNT)
    rows["action"], rows["behavior_mean"] = (random_actions(seed).float() for seed in (1, 2))
    rows["behavior_sigma"] = torch.rand(COUNT, 1, generator=seeded(3))
    assert (rows["behavior_sigma"] < 0.2).any()
    replay = make_ref_er(learner, rows)
    replay.buffer.sampler.batches = batches
    (draw,) = replay.select(replay.buffer)
    batch, limit, far = draw.batch, 1 + 4 / (1 + 5e-7 * batches), set()
    with torch.no_grad():
        now = learner.policy(batch.select("observation"))["action"]
    stored = rows["behavior_sigma"][batch["index"], 0].tolist()
    for row, sigma in enumerate(stored):
        spread = max(sigma, 0.2)
        action, mean = batch["action"][row].tolist(), batch["behavior_mean"][row].tolist()
        ratio = density(action, now[row].tolist(), spread) / density(action, mean, spread)
        assert float(batch["priority_weight"][row]) == (1 / limit < ratio < limit)
        far |= {"low"} if ratio <= 1 / limit else {"high"} if ratio >= limit else {"near"}
        assert float(batch["behavior_sigma"][row]) == pytest.approx(spread)
    assert far == {"low", "high", "near"}


def test_far_transitions_teach_neither_critic_nor_actor():
    """The update is that of the near transitions alone, over the size of the batch."""
    learner = make_learner(**loss_options("ref_er"))
    replay = make_ref_er(learner, rows_near_and_far(learner, 1.0))
    replay.buffer.sampler.policy_weight = 1.0  # Nothing holds the actor.
    (draw,) = replay.select(replay.buffer)
    losses = differentiate(learner, draw.batch)
    near = draw.batch["priority_weight"].bool()
    alone = draw.batch[near].exclude("policy_weight", "priority_weight")
    expected = differentiate(learner, alone)
    for name in ("loss_value", "loss_actor"):
        scaled = expected[name] * near.sum() / len(near)
        torch.testing.assert_close(losses[name], scaled, rtol=1e-4, atol=1e-6)


def test_weight_falls_while_too_many_transitions_are_far():
    learner = make_learner(**loss_options("ref_er"))
    replay = make_ref_er(learner, rows_near_and_far(learner, 1.0))
    sampler = replay.buffer.sampler
    sampler.policy_weight = weight = 1.0
    for number in range(5):
        (draw,) = replay.select(replay.buffer)
        assert draw.batch["policy_weight"].max() == pytest.approx(weight)
        assert draw.batch["behavior_weight"].min() == pytest.approx(1 - weight, abs=1e-6)
        far = 1 - float(draw.batch["priority_weight"].mean())
        assert far > 0.3
        weight = 0.9 * weight  # eta is 0.1 B / N, and here B = N.
        assert sampler.policy_weight == pytest.approx(weight)
        assert sampler.batches == number + 1
    near = make_ref_er(learner, rows_near_and_far(learner, 0.0))
    near.buffer.sampler.policy_weight = 0.5
    list(near.select(near.buffer))
    assert near.buffer.sampler.policy_weight == pytest.approx(0.55)
    for weight, expected in ((0.5, 0.6), (0.9, 0.82)):
        found = next_weight(weight, far=0.1, allowed=0.1, rate=0.2)
        assert found == pytest.approx(expected)


def test_loss_of_the_actor_is_that_of_the_formula():
    loss, weight, held = (torch.rand(5, generator=seeded(n)) for n in range(3))
    action, mean = (random_actions(n, 5).float() for n in (3, 4))
    sigma = torch.rand(5, 1, generator=seeded(5)) + 0.2
    entries = {"behavior_mean": mean, "behavior_sigma": sigma}
    entries |= {"policy_weight": weight, "behavior_weight": held}
    found = trusted_loss(loss, action, TensorDict(entries, [5]))
    for row in range(5):
        divergence = sum(
            (float(a) - float(m)) ** 2 / (2 * float(sigma[row]) ** 2)
            for a, m in zip(action[row], mean[row], strict=True)
        )
        expected = float(weight[row]) * float(loss[row]) + float(held[row]) * divergence
        assert float(found[row]) == pytest.approx(expected, rel=1e-5)


def test_sac_is_held_and_set_free_as_well():
    learner = ActorCritic(*make_networks(stochastic=True), signals=[])
    rows, found = make_rows(20), []
    rows["behavior_mean"] = torch.full((20, 2), 5.0)
    rows["behavior_sigma"] = torch.ones(20, 1)
    for policy, behavior in ((1.0, 0.0), (0.25, 0.0), (0.0, 1.0)):
        rows["policy_weight"] = torch.full((20,), policy)
        rows["behavior_weight"] = torch.full((20,), behavior)
        found.append(float(differentiate(learner, rows, trains="actor")["loss_actor"]))
    assert found[1] == pytest.approx(0.25 * found[0], rel=1e-5)
    # From actions in [-1, 1] it is 4 to 6 to the mean of the behavior.
    assert 4**2 < found[2] < 6**2


@pytest.mark.parametrize("way", ["state", "folder"])
def test_weight_is_saved_and_loaded(way, tmp_path):
    first, second = (make_buffer(ReFERSampler(), 9, 2) for _ in range(2))
    first.sampler.policy_weight, first.sampler.batches = 0.25, 7
    restore(second, first, tmp_path if way == "folder" else None)
    assert (second.sampler.policy_weight, second.sampler.batches) == (0.25, 7)
    for name, wrong in (("policy_weight", 1.5), ("batches", -1)):
        with pytest.raises(ValueError, match=f"{name} must be"):
            second.sampler.load_state_dict({**first.sampler.state_dict(), name: wrong})
    assert second.sampler.policy_weight == 0.25


def test_buffer_that_is_emptied_begins_with_the_first_weight():
    buffer = make_buffer(ReFERSampler(), 9, 2)
    buffer.sampler.policy_weight, buffer.sampler.batches = 0.25, 7
    buffer.empty()
    assert (buffer.sampler.policy_weight, buffer.sampler.batches) == (1e-4, 7)


def test_missing_entry_or_part_is_named():
    with pytest.raises(ValueError, match="method 'ref_er' needs policy"):
        make_replay("ref_er")
    policy = make_actor(6, 2, width=8)
    with pytest.raises(TypeError, match="buffer must have a ReFERSampler"):
        next(ReFERSelection(policy)(make_buffer(make_replay("ddpg").buffer.sampler, 5, 2)))
    replay = make_replay("ref_er", policy=policy, capacity=10, batch_size=4)
    assert replay.entries == ("behavior_mean", "behavior_sigma")
    rows = make_transitions(10)
    rows["observation"], rows["action"] = torch.rand(10, 6), torch.rand(10, 2)
    replay.buffer.extend(rows)
    with pytest.raises(KeyError, match="behavior_sigma"):
        list(replay.select(replay.buffer))
