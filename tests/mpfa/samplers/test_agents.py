"""Several agents: one reward and one signal each, of which the sampler makes a transition's."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage
from torchrl.objectives import DDPGLoss

from torchrl_mpfa import MPFASampler, SignalReplayBuffer, write_signals

AGENTS, OBSERVED, ACTIONS = 3, 4, 2
GROUP = "agents"
REWARD_KEY = ("next", GROUP, "reward")


class LinearCritic(nn.Module):
    """Q of each agent, linear in its own observation and action."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(OBSERVED + ACTIONS, 1)

    def forward(self, observation, action):
        return self.layer(torch.cat([observation, action], -1))


def make_rows(count, *, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(size):
        return torch.randn(count, AGENTS, size, generator=generator)

    end = torch.zeros(count, AGENTS, 1, dtype=torch.bool)
    after = {
        "observation": normal(OBSERVED),
        "reward": normal(1),
        "done": end,
        "terminated": end.clone(),
    }
    now = {"observation": normal(OBSERVED), "action": normal(ACTIONS).tanh()}
    shape = [count, AGENTS]
    return TensorDict(
        {GROUP: TensorDict(now, shape), "next": {GROUP: TensorDict(after, shape)}}, [count]
    )


def make_loss():
    torch.manual_seed(0)
    actor = TensorDictModule(
        nn.Linear(OBSERVED, ACTIONS), [(GROUP, "observation")], [(GROUP, "action")]
    )
    keys = [(GROUP, "observation"), (GROUP, "action")]
    critic = TensorDictModule(LinearCritic(), keys, [(GROUP, "state_action_value")])
    loss = DDPGLoss(actor, critic)
    names = ("state_action_value", "reward", "done", "terminated")
    loss.set_keys(priority=(GROUP, "td_error"), **{name: (GROUP, name) for name in names})
    loss.make_value_estimator(gamma=0.9)
    return loss


def make_buffer(agents, *, filled=40):
    buffer = SignalReplayBuffer(
        storage=LazyTensorStorage(100),
        sampler=MPFASampler(reward_key=REWARD_KEY, agents=agents),
        batch_size=8,
    )
    buffer.extend(make_rows(filled))
    return buffer


@pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")
def test_signals_of_maddpg_are_one_for_each_agent():
    loss, rows = make_loss(), make_rows(8)
    loss(rows)
    write_signals(rows, loss)
    error, slope = (rows["signals", name] for name in ("td_error", "action_gradient"))
    torch.testing.assert_close(error.square(), rows[GROUP, "td_error"])
    weight = loss.value_network_params["module", "layer", "weight"].detach()
    expected = weight[0, OBSERVED:].norm().expand(8, AGENTS)
    torch.testing.assert_close(slope, expected)


@pytest.mark.parametrize(
    ("agents", "pick"),
    [
        ("mean", lambda value: value.mean(1)),
        ("max", lambda value: value[torch.arange(len(value)), value.abs().argmax(1)]),
    ],
)
def test_number_of_a_transition_is_the_largest_or_the_mean_of_its_agents(agents, pick):
    buffer = make_buffer(agents)
    rewards = pick(make_rows(40)[REWARD_KEY].squeeze(-1).double())
    torch.testing.assert_close(buffer.rewards(), rewards)
    assert rewards.min() < 0 < rewards.max()
    batch = buffer.sample()
    errors = torch.rand(8, AGENTS)
    batch["signals"] = TensorDict(
        {"td_error": errors, "action_gradient": torch.rand(8, AGENTS)}, [8]
    )
    buffer.update_tensordict_priority(batch)
    table, last = buffer.sampler.table, batch["index"].flip(0).unique(return_inverse=True)[0]
    for slot in last.tolist():
        place = int((batch["index"] == slot).nonzero()[-1])
        found = table.rows[slot, table.column["td_error"]]
        assert found.item() == pytest.approx(float(pick(errors)[place]))


@pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")
@pytest.mark.parametrize("agents", ["mean", "max"])
def test_maddpg_trains_by_priorities_with_a_weight_for_each_agent(agents):
    loss, buffer = make_loss(), make_buffer(agents)
    before = buffer.sampler.priorities()[:40].clone()
    for _ in range(5):
        batch = buffer.sample()
        batch["priority_weight"] = batch["priority_weight"][:, None].expand(-1, AGENTS)
        values = loss(batch)
        write_signals(batch, loss)
        (values["loss_actor"] + values["loss_value"]).backward()
        buffer.update_tensordict_priority(batch)
    assert (buffer.sampler.priorities()[:40] != before).any()
    assert set(buffer.sampler.weights) == {"reward", "td_error", "action_gradient"}


def test_several_numbers_of_a_transition_are_rejected_where_no_agents_are_named():
    remedy = r"of shape \[40, 3, 1\] for 40 transitions: of several agents give .* agents='max'"
    with pytest.raises(ValueError, match=remedy):
        make_buffer(None)
    with pytest.raises(ValueError, match="agents must be 'max', 'mean' or None, got 'sum'"):
        MPFASampler(agents="sum")
