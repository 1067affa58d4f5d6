"""The action gradient out of the backward pass of the critic's loss: the same, and never stale."""

import copy

import pytest
import torch

from tests.mpfa.losses import BOUNDS, GAMMA, make_batch, make_networks
from torchrl_mpfa import DDPGLearner, TD3Learner, make_ddpg_loss, make_td3_loss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

LOSSES = {"ddpg": (make_ddpg_loss, "loss_value"), "td3": (make_td3_loss, "value_loss")}
SIGNAL = ("signals", "action_gradient")


def critic_loss(name, **kwargs):
    """A loss, and its method that computes the critic's loss."""
    make, method = LOSSES[name]
    more = {"bounds": BOUNDS} if name == "td3" else {}
    loss = make(*make_networks(), gamma=GAMMA, **more, **kwargs)
    return loss, getattr(loss, method)


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"reward_scale": 0.1},
        {"gradient_order": 1.0},
        {"loss_function": "smooth_l1"},
        {"importance": "torchrl"},
    ],
    ids=str,
)
def test_a_deferred_gradient_equals_that_of_a_backward_pass_of_its_own(name, options):
    loss, compute = critic_loss(name, **options)
    direct, deferred = make_batch(), make_batch()
    compute(direct)
    total, _ = compute(deferred, defer_gradient=True)
    total.backward()
    loss.write_action_gradient(deferred)
    torch.testing.assert_close(deferred[SIGNAL], direct[SIGNAL], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("name", LOSSES)
def test_deferring_changes_no_gradient_of_the_parameters(name):
    grads = []
    for defer in (False, True):
        loss, compute = critic_loss(name)
        compute(make_batch(), defer_gradient=defer)[0].backward()
        grads.append({n: p.grad for n, p in loss.named_parameters() if p.grad is not None})
    assert grads[0].keys() == grads[1].keys()
    for key, value in grads[0].items():
        torch.testing.assert_close(value, grads[1][key])


@pytest.mark.parametrize("name", LOSSES)
def test_a_transition_without_error_has_its_gradient_too(name):
    loss, compute = critic_loss(name)
    direct, deferred = make_batch(), make_batch()
    compute(direct)
    # A weight of zero takes the transition out of the loss, as an error of zero would.
    deferred["priority_weight"] = torch.tensor([0.0, 1.0, 0.0, 1.0, 1.0, 1.0])
    total, _ = compute(deferred, defer_gradient=True)
    total.backward()
    loss.write_action_gradient(deferred)
    assert deferred[SIGNAL].isfinite().all()
    torch.testing.assert_close(deferred[SIGNAL], direct[SIGNAL], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("name", LOSSES)
def test_until_the_backward_pass_there_is_no_gradient(name):
    loss, compute = critic_loss(name)
    batch = make_batch()
    compute(batch, defer_gradient=True)
    assert SIGNAL not in batch.keys(include_nested=True)
    with pytest.raises(RuntimeError, match="call backward"):
        loss.write_action_gradient(batch)


@pytest.mark.parametrize("name", LOSSES)
def test_without_something_deferred_nothing_is_written(name):
    loss, compute = critic_loss(name)
    batch = make_batch()
    total, _ = compute(batch, defer_gradient=True)
    total.backward()
    loss.write_action_gradient(batch)
    written = batch[SIGNAL].clone()
    batch[SIGNAL] = written + 1.0
    loss.write_action_gradient(batch)
    assert batch[SIGNAL].equal(written + 1.0)


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_with_a_deferred_gradient_can_be_copied(name):
    loss, compute = critic_loss(name)
    compute(make_batch(), defer_gradient=True)
    copied = copy.deepcopy(loss)
    copied.write_action_gradient(make_batch())


@pytest.mark.parametrize("name", LOSSES)
def test_under_no_grad_the_gradient_is_written_at_once(name):
    _, compute = critic_loss(name)
    batch = make_batch()
    with torch.no_grad():
        compute(batch, defer_gradient=True)
    assert SIGNAL in batch.keys(include_nested=True)


@pytest.mark.parametrize("kind", [DDPGLearner, TD3Learner])
def test_a_learner_writes_the_gradient_of_the_critic_before_its_step(kind):
    name = "ddpg" if kind is DDPGLearner else "td3"
    loss, _ = critic_loss(name)
    expected, batch = make_batch(), make_batch()
    critic_loss(name)[1](expected)
    kind(loss, critic_lr=0.1).update(batch)
    torch.testing.assert_close(batch[SIGNAL], expected[SIGNAL], rtol=1e-5, atol=1e-7)
