"""Signals of TorchRL's own losses: those of ours with the same networks."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch._dynamo.testing import CompileCounterWithBackend
from torchrl.data import Bounded
from torchrl.modules import MLP, QValueActor, ValueOperator
from torchrl.objectives import ClipPPOLoss, DDPGLoss, DQNLoss, IQLLoss, TD3Loss

from tests.mpfa.learning import (
    KINDS,
    differentiate,
    make_apart,
    make_batch,
    make_networks,
    make_torchrls,
)
from torchrl_mpfa import make_critic, make_stochastic_actor, write_signals

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")
BOUNDS = {"bounds": (-1.0, 1.0)}
QUIET = {**BOUNDS, "policy_noise": 0.0}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("order", [1.0, 2.0])
def test_signals_are_those_of_our_learner_with_the_same_networks(kind, order):
    learner = make_apart(kind, gradient_order=order)
    theirs = make_torchrls(kind, learner)
    first, second = make_batch(32), make_batch(32)
    differentiate(learner, first)
    torch.manual_seed(1)
    theirs(second)
    write_signals(second, theirs, order=order)
    for name in ("td_error", "action_gradient"):
        expected = first["signals", name]
        assert second["signals", name].shape == (32,)
        assert expected.max() > 0.01
        torch.testing.assert_close(second["signals", name], expected, rtol=1e-4, atol=1e-5)


def test_td_error_that_a_part_of_a_loss_returns_is_written_by_hand():
    actor, critic = make_networks()
    loss = TD3Loss(actor, critic, loss_function="l2", num_qvalue_nets=2, **QUIET)
    loss.make_value_estimator(gamma=0.99)
    whole, parted = make_batch(16), make_batch(16)
    loss(whole)
    write_signals(whole, loss)
    _, extra = loss.value_loss(parted)
    with pytest.raises(KeyError, match="value_loss of TD3Loss, may return the error and not write"):
        write_signals(parted, loss)
    parted["td_error"] = extra["td_error"].detach().amax(0)
    write_signals(parted, loss)
    torch.testing.assert_close(parted["signals", "td_error"], whole["signals", "td_error"])


def test_writing_signals_leaves_gradients_and_graph_as_they_were():
    loss = DDPGLoss(*make_networks(), loss_function="l2")
    loss.make_value_estimator(gamma=0.99)
    plain, written = make_batch(8), make_batch(8)
    sum(value for name, value in loss(plain).items() if name.startswith("loss")).backward()
    expected = [p.grad.clone() for p in loss.parameters() if p.grad is not None]
    loss.zero_grad()
    total = sum(value for name, value in loss(written).items() if name.startswith("loss"))
    write_signals(written, loss)
    total.backward()
    found = [p.grad for p in loss.parameters() if p.grad is not None]
    assert all(map(torch.equal, expected, found))
    assert not written["signals", "action_gradient"].requires_grad


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning")
@pytest.mark.parametrize("kind", KINDS)
def test_signals_outside_of_a_compiled_loss_leave_it_one_graph(kind):
    loss = make_torchrls(kind, make_apart(kind))
    loss(make_batch(16))
    torch.compiler.reset()
    counter = CompileCounterWithBackend("eager")
    compiled = torch.compile(loss, backend=counter, fullgraph=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    for given in (loss, compiled, loss):
        batch, plain = make_batch(16), make_batch(16)
        torch.manual_seed(1)
        loss(plain)
        write_signals(plain, loss)
        torch.manual_seed(1)
        values = compiled(batch)
        write_signals(batch, given)
        sum(value for name, value in values.items() if name.startswith("loss")).backward()
        optimizer.step()
        optimizer.zero_grad()
        torch.testing.assert_close(batch["signals"], plain["signals"])
    assert counter.frame_count == 1


def test_dqn_has_a_td_error_alone():
    network = QValueActor(nn.Linear(3, 4), in_keys=["observation"], action_space="categorical")
    loss = DQNLoss(network, loss_function="l2", action_space="categorical")
    loss.make_value_estimator(gamma=0.9)
    after = {"observation": torch.rand(8, 3), "reward": torch.rand(8, 1)}
    end = torch.zeros(8, 1, dtype=torch.bool)
    rows = {"observation": torch.rand(8, 3), "action": torch.randint(4, (8,))}
    rows["next"] = {**after, "done": end, "terminated": end.clone()}
    batch = TensorDict(rows, [8])
    loss(batch)
    write_signals(batch, loss)
    assert set(batch["signals"].keys()) == {"td_error"}
    assert batch["signals", "td_error"].square().allclose(batch["td_error"].reshape(-1), atol=1e-6)


def test_a_batch_that_the_loss_has_not_seen_and_another_loss_are_rejected():
    loss = DDPGLoss(*make_networks(), loss_function="l2")
    with pytest.raises(KeyError, match=r"'td_error' is missing in the batch: call loss\(batch\)"):
        write_signals(make_batch(4), loss)
    with pytest.raises(TypeError, match=r"such as DDPGLoss, got ClipPPOLoss: write batch\["):
        write_signals(make_batch(4), ClipPPOLoss.__new__(ClipPPOLoss))


def make_agents_loss(critic, action="action"):
    seen = [("agents", "observation")]
    actor = TensorDictModule(nn.Sequential(nn.Linear(3, 2), nn.Tanh()), seen, [("agents", action)])
    keys = [*seen, ("agents", action)]
    values = TensorDictModule(critic, keys, [("agents", "state_action_value")])
    loss = DDPGLoss(actor, values)
    ends = {name: ("agents", name) for name in ("reward", "done", "terminated")}
    loss.set_keys(state_action_value=("agents", "state_action_value"), **ends)
    loss.make_value_estimator(gamma=0.9)
    return loss


def make_agents_batch(action="action"):
    end = torch.zeros(8, 2, 1, dtype=torch.bool)
    after = {"observation": torch.rand(8, 2, 3), "reward": torch.rand(8, 2, 1)}
    after |= {"done": end, "terminated": end}
    now = {"observation": torch.rand(8, 2, 3), action: torch.rand(8, 2, 2)}
    return TensorDict({"agents": now, "next": {"agents": after}}, [8])


class Rivals(nn.Module):
    """One critic of both agents' actions, whose values are opposite."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(4, 1)

    def forward(self, seen, action):
        value = self.layer(action.flatten(-2))
        return torch.stack([value, -value], -2)


class Apart(nn.Module):
    """A critic of each agent's own action."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(2, 1)

    def forward(self, seen, action):
        return self.layer(action)


@pytest.mark.parametrize("critic", [Rivals, Apart])
def test_the_slope_of_an_agent_is_that_of_its_own_value(critic):
    loss, batch = make_agents_loss(critic()), make_agents_batch()
    loss(batch)
    write_signals(batch, loss)
    weight = loss.value_network_params["module", "layer", "weight"].reshape(-1, 2)
    expected = weight.norm(dim=-1).expand(8, 2)
    torch.testing.assert_close(batch["signals", "action_gradient"], expected)


def test_an_action_of_another_name_is_what_actor_and_critic_share():
    loss, batch = make_agents_loss(Apart(), "wheels"), make_agents_batch("wheels")
    loss(batch)
    write_signals(batch, loss)
    assert batch["signals", "action_gradient"].min() > 0


def test_a_critic_that_reads_no_action_of_the_actor_is_rejected_by_name():
    loss, batch = make_agents_loss(Apart(), "wheels"), make_agents_batch("wheels")
    loss(batch)
    loss.value_network.in_keys = [("agents", "observation")]
    with pytest.raises(KeyError, match="the critic must read one action of the actor, got"):
        write_signals(batch, loss)


@pytest.mark.parametrize("where", ["batch", "call"])
def test_signals_are_those_outside_of_inference_mode(where):
    loss = DDPGLoss(*make_networks(), loss_function="l2")
    loss.make_value_estimator(gamma=0.99)
    first = make_batch(16)
    with torch.inference_mode(where == "batch"):
        second = make_batch(16)
    loss(first)
    with torch.inference_mode():
        loss(second)
    write_signals(first, loss)
    with torch.inference_mode(where == "call"):
        write_signals(second, loss)
    for name in ("td_error", "action_gradient"):
        torch.testing.assert_close(second["signals", name], first["signals", name])


@pytest.mark.filterwarnings("ignore")
def test_a_single_critic_that_is_not_stacked_has_a_slope():
    actor = make_stochastic_actor(3, 2, action_spec=Bounded(-1.0, 1.0, (2,)), width=8)
    value = ValueOperator(MLP(3, 1, num_cells=[8]), in_keys=["observation"])
    loss = IQLLoss(actor, make_critic(3, 2, width=8), value, num_qvalue_nets=1)
    loss.make_value_estimator(gamma=0.9)
    end = torch.zeros(4, 1, dtype=torch.bool)
    after = {"observation": torch.rand(4, 3), "reward": torch.rand(4, 1)}
    after |= {"done": end, "terminated": end}
    rows = {"observation": torch.rand(4, 3), "action": torch.rand(4, 2), "next": after}
    batch = TensorDict(rows, [4])
    loss(batch)
    write_signals(batch, loss)
    assert batch["signals", "action_gradient"].shape == (4,)
