"""An update as one program: the same numbers as the losses give, whatever their options."""

import pytest
import torch
from tensordict.nn import TensorDictModule

from tests.mpfa.losses import BOUNDS, GAMMA, make_batch, make_networks
from torchrl_mpfa import DDPGLearner, TD3Learner, make_ddpg_loss, make_td3_loss
from torchrl_mpfa.learners.compiled import CompiledGradients

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

MAKE = {"ddpg": make_ddpg_loss, "td3": make_td3_loss}
LEARNERS = {"ddpg": DDPGLearner, "td3": TD3Learner}
# Python stands in for the C++ compiler: what is traced is the same.
TRACED = {"backend": "eager"}


def make_loss(name, **options):
    more = {"bounds": BOUNDS} if name == "td3" else {}
    loss = MAKE[name](*make_networks(), gamma=GAMMA, **more, **options)
    with torch.no_grad():  # Targets of their own, lest a mix-up goes unseen.
        for key, value in loss.named_buffers():
            if key.startswith("target_"):
                value.mul_(0.9)
    return loss


def by_losses(name, loss, batch, trains="both", **kwargs):
    """Gradients and values for the log as TorchRL's interface gives them."""
    of_critic, of_actor = {
        "ddpg": ("loss_value", "loss_actor"),
        "td3": ("value_loss", "actor_loss"),
    }[name]
    log = {}
    if trains != "actor":
        log["loss_value"], more = getattr(loss, of_critic)(batch, **kwargs)
        log.update(more)
    if trains != "critic":
        log["loss_actor"], more = getattr(loss, of_actor)(batch)
        log.update(more)
    sum(value for key, value in log.items() if key.startswith("loss")).backward()
    return {n: p.grad for n, p in loss.named_parameters() if p.grad is not None}, log


@pytest.mark.parametrize("name", MAKE)
@pytest.mark.parametrize("weighted", [True, False], ids=["weights", "no weights"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"reward_scale": 0.1, "saturation_penalty": 2.0, "saturation_limit": 0.1},
        {"gradient_order": 1.0},
        {"loss_function": "smooth_l1"},
        {"importance": "none", "signals": ["td_error"]},
        {"signals": []},
        {"signals": ["value"], "loss_function": "pal", "pal_alpha": 0.7},
        {"target_average": 3},
    ],
    ids=str,
)
def test_gradients_signals_and_log_are_those_of_the_losses(name, weighted, options):
    expected, batch = (make_batch(weighted=weighted) for _ in range(2))
    loss, whole = make_loss(name, **options), make_loss(name, **options)
    torch.manual_seed(5)  # TD3 has noise in its targets.
    gradients, log = by_losses(name, loss, expected)
    torch.manual_seed(5)
    found = CompiledGradients(whole, compile=None)(batch)
    again = {n: p.grad for n, p in whole.named_parameters() if p.grad is not None}
    assert again.keys() == gradients.keys()
    for key, value in gradients.items():
        torch.testing.assert_close(again[key], value, rtol=1e-4, atol=1e-6)
    signals = batch.get("signals", {})
    assert set(signals.keys()) == set(expected.get("signals", {}).keys())
    for key in signals.keys():  # noqa: SIM118
        torch.testing.assert_close(signals[key], expected["signals", key])
    for key, value in found.items():
        torch.testing.assert_close(value.reshape(log[key].shape), log[key].detach())


@pytest.mark.parametrize("name", MAKE)
def test_the_critic_may_learn_by_another_distance(name):
    expected, batch = (make_batch() for _ in range(2))
    loss, whole = make_loss(name), make_loss(name)
    torch.manual_seed(5)
    gradients, _ = by_losses(name, loss, expected, loss_function="smooth_l1")
    torch.manual_seed(5)
    CompiledGradients(whole, compile=None)(batch, loss_function="smooth_l1")
    again = {n: p.grad for n, p in whole.named_parameters() if p.grad is not None}
    assert again.keys() == gradients.keys()
    for key, value in gradients.items():
        torch.testing.assert_close(again[key], value, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", MAKE)
@pytest.mark.parametrize("trains", ["critic", "actor"])
def test_critic_or_actor_alone_get_the_gradients_of_their_loss(name, trains):
    options = {"saturation_penalty": 2.0, "saturation_limit": 0.1}
    loss, whole = make_loss(name, **options), make_loss(name, **options)
    torch.manual_seed(5)
    gradients, log = by_losses(name, loss, make_batch(), trains)
    gradients_of = CompiledGradients(whole, compile=None)
    gradients_of(make_batch())  # Gradients of an earlier batch must not move the other again.
    torch.manual_seed(5)
    batch = make_batch()
    found = gradients_of(batch, trains=trains)
    assert ("signals" in batch.keys()) == (trains == "critic")  # noqa: SIM118
    assert {key for key in found if key.startswith("loss")} == {
        "loss_value" if trains == "critic" else "loss_actor"
    }
    for key, value in found.items():
        torch.testing.assert_close(value.reshape(log[key].shape), log[key].detach())
    again = {n: p.grad for n, p in whole.named_parameters() if p.grad is not None}
    assert again.keys() == gradients.keys()
    for key, value in gradients.items():
        torch.testing.assert_close(again[key], value, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_traced_learner_takes_the_same_steps(name):
    plain, traced = (
        LEARNERS[name](make_loss(name), actor_lr=1e-3, critic_lr=1e-3, compile=compile)
        for compile in (False, TRACED)
    )
    for seed in range(6):
        one, other = (make_batch(seed=seed, weighted=True) for _ in range(2))
        torch.manual_seed(seed)
        plain.update(one)
        torch.manual_seed(seed)
        traced.update(other)
        torch.testing.assert_close(other["signals"].to_dict(), one["signals"].to_dict())
    expected = dict(plain.loss.named_parameters()) | dict(plain.loss.named_buffers())
    found = dict(traced.loss.named_parameters()) | dict(traced.loss.named_buffers())
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_traced_learner_goes_on_from_a_state_that_is_loaded(name):
    first, second = (
        LEARNERS[name](make_loss(name), critic_lr=1e-2, compile=TRACED) for _ in range(2)
    )
    second.update(make_batch(seed=9))
    for seed in range(3):
        first.update(make_batch(seed=seed))
    second.load_state_dict(first.state_dict())
    logs = []
    for learner in (first, second):
        torch.manual_seed(1)
        logs.append(learner.update(make_batch(seed=4)))
    assert all(logs[0][key].equal(logs[1][key]) for key in logs[0])


def test_what_cannot_be_one_program_is_refused_by_name():
    actor, critic = make_networks()
    wrapped = TensorDictModule(actor.module, actor.in_keys, actor.out_keys)
    with pytest.raises(ValueError, match="DirectModule as actor_network, got TensorDictModule"):
        DDPGLearner(make_ddpg_loss(wrapped, critic), compile=True)
    with pytest.raises(ValueError, match="importance"):
        DDPGLearner(make_loss("ddpg", importance="torchrl"), compile=True)
    with pytest.raises(ValueError, match="reduction = 'mean' in the loss, got 'sum'"):
        DDPGLearner(make_loss("ddpg", reduction="sum"), compile=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNERS)
def test_a_compiled_learner_takes_the_same_steps(name):
    plain, compiled = (
        LEARNERS[name](make_loss(name), critic_lr=1e-3, compile=compile)
        for compile in (False, True)
    )
    for seed in range(4):
        logs = []
        for learner in (plain, compiled):
            torch.manual_seed(seed)
            logs.append(learner.update(make_batch(seed=seed)))
        torch.testing.assert_close(logs[0]["loss_value"], logs[1]["loss_value"])
