"""LA3P: three parts of a batch, each with the probabilities that it should have."""

import pytest
import torch

from tests.methods.replays import assert_shares, make_buffer, make_transitions, seeded, set_signals
from torchrl_mpfa import DDPGLearner, Draw, SignalSampler, TD3Learner, make_actor, make_critic
from torchrl_mpfa.losses import make_ddpg_loss, make_td3_loss
from torchrl_mpfa.methods import LA3PSampler, PriorityFloor, split_draws

ALPHA = 0.4


def make_la3p(capacity, batch_size, *, filled=None, **kwargs):
    sampler = LA3PSampler(
        capacity,
        ALPHA,
        0.0,
        0.0,
        signals=["td_error"],
        adjustments=[PriorityFloor(1.0)],
        **kwargs,
    )
    return make_buffer(sampler, capacity, batch_size, filled=filled)


def shares_by_hand(errors):
    leaf = [max(error, 1.0) ** ALPHA for error in errors]
    inverse = [1.0 / value for value in leaf]
    return [
        torch.tensor([v / sum(each) for v in each], dtype=torch.double)
        for each in ([1.0] * len(leaf), leaf, inverse)
    ]


def assert_parts(buffer, errors, *, samples):
    first, second = split_draws(buffer)
    indices = (first.batch["index"], second.batch["index"], second.actor_batch["index"])
    for index, expected in zip(indices, shares_by_hand(errors.tolist()), strict=True):
        assert len(index) == samples
        assert_shares(index, expected, samples=samples)


def test_the_parts_are_uniform_by_priority_and_by_its_inverse():
    errors = torch.rand(15, generator=seeded(3)) * 10
    buffer = make_la3p(15, 40_000)
    set_signals(buffer, td_error=errors)
    assert_parts(buffer, errors, samples=20_000)


def test_the_parts_are_right_after_the_ring_buffer_has_wrapped():
    """The public code looks at the slots before the cursor alone, and misses all others."""
    buffer = make_la3p(15, 40_000)
    set_signals(buffer, td_error=torch.full((15,), 3.0))
    buffer.extend(make_transitions(4, seed=9))  # Wraps: slots 0 to 3 are new.
    errors = torch.rand(15, generator=seeded(4)) * 10
    set_signals(buffer, td_error=errors)
    assert_parts(buffer, errors, samples=20_000)


def test_the_parts_are_right_in_a_buffer_that_is_not_full_and_after_loading():
    first, second = (make_la3p(50, 40_000, filled=9 if n == 0 else 0) for n in range(2))
    errors = torch.rand(9, generator=seeded(5)) * 10
    set_signals(first, td_error=errors)
    second.load_state_dict(first.state_dict())
    for buffer in (first, second):
        assert_parts(buffer, errors, samples=20_000)


@pytest.mark.parametrize(("fraction", "expected"), [(0.5, (128, 128, 128)), (0.25, (64, 192, 192))])
def test_critic_and_actor_each_learn_from_a_whole_batch(fraction, expected):
    buffer = make_la3p(300, 256, uniform_fraction=fraction)
    first, second = split_draws(buffer)
    sizes = (len(first.batch), len(second.batch), len(second.actor_batch))
    assert sizes == expected
    assert first.actor_batch is None
    assert (first.loss_function, second.loss_function) == ("pal", "smooth_l1")


def test_both_halves_of_the_critics_batch_update_priorities():
    buffer = make_la3p(400, 64)
    for draw in split_draws(buffer):
        draw.batch["signals", "td_error"] = torch.full((len(draw.batch),), 7.0)
        buffer.update_tensordict_priority(draw.batch)
        leaves = torch.as_tensor(buffer.sampler._sum_tree[draw.batch["index"]])
        torch.testing.assert_close(leaves, torch.full_like(leaves, 7.0**ALPHA))


def test_a_delayed_actor_counts_training_steps_and_not_their_batches():
    networks = make_actor(24, 2, width=8), make_critic(24, 2, width=8)
    loss = make_td3_loss(*networks, bounds=(-1.0, 1.0))
    learner = TD3Learner(loss, policy_delay=2)
    batch = whole_transitions(12)
    logs = [
        learner.update(Draw(batch[:4], actor_batch=batch[8:], new_step=new))
        for new in (True, False, True, False)
    ]
    assert ["loss_actor" in log for log in logs] == [False, False, True, True]


def test_the_actor_learns_from_its_own_batch():
    """With a batch of its own the actor's step is as if the whole update had been that batch."""
    steps = []
    whole = whole_transitions(12)
    for kwargs in ({}, {"actor_batch": whole[6:]}):
        torch.manual_seed(0)
        loss = make_ddpg_loss(make_actor(24, 2, width=8), make_critic(24, 2, width=8))
        learner = DDPGLearner(loss)
        learner.update(Draw((whole[:6] if kwargs else whole[6:]).clone(), **kwargs))
        steps.append([value.clone() for value in learner.policy.parameters()])
    # Adam's first step has the sign of the gradient alone: compare its direction.
    for one, other in zip(*steps, strict=True):
        torch.testing.assert_close(one, other)


def whole_transitions(count):
    from tensordict import TensorDict

    generator = seeded(6)
    end = torch.zeros(count, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": torch.randn(count, 24, generator=generator),
            "action": torch.rand(count, 2, generator=generator) * 2 - 1,
            "next": {
                "observation": torch.randn(count, 24, generator=generator),
                "reward": torch.randn(count, 1, generator=generator),
                "terminated": end,
                "done": end.clone(),
            },
        },
        [count],
    )


def test_what_cannot_be_parted_is_refused():
    with pytest.raises(ValueError, match=r"uniform_fraction must be in \(0, 1\), got 1.0"):
        make_la3p(4, 4, uniform_fraction=1.0)
    with pytest.raises(ValueError, match="batch_size must leave no part empty, got 1"):
        make_la3p(30, 4).sampler.sizes(1)
    other = make_buffer(SignalSampler(4, 0.6, 0.4, 0.1), 4, 2)
    with pytest.raises(TypeError, match="buffer must have an LA3PSampler, got SignalSampler"):
        next(split_draws(other))


def test_the_second_part_knows_the_priorities_that_the_first_one_learned():
    """Where the uniform part finds one large error, the prioritized part finds it as well."""
    errors = torch.zeros(2000)
    buffer = make_la3p(2000, 400)
    set_signals(buffer, td_error=errors)
    draws = split_draws(buffer)
    first = next(draws)
    assert first.new_step
    slot = int(first.batch["index"][0])
    learned = (first.batch["index"] == slot).float() * 1e9  # To the power of 0.4: 4,000.
    first.batch["signals", "td_error"] = learned
    buffer.update_tensordict_priority(first.batch)
    second = next(draws)
    assert not second.new_step
    assert (second.batch["index"] == slot).sum() > 60
    assert (second.actor_batch["index"] != slot).all()


def test_a_whole_batch_outside_of_a_training_step_is_by_priority():
    errors = torch.rand(15, generator=seeded(3)) * 10
    buffer = make_la3p(15, 20_000)
    set_signals(buffer, td_error=errors)
    assert_shares(buffer.sample()["index"], shares_by_hand(errors.tolist())[1], samples=20_000)
