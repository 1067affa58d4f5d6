"""What TorchRL's losses write as TD error, and whether they use weights, as a page says."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
import torchrl.objectives as objectives
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.data import Bounded, LazyTensorStorage, OneHot, TensorDictReplayBuffer
from torchrl.modules import (
    DistributionalQValueActor,
    OneHotCategorical,
    ProbabilisticActor,
    QValueActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import LossModule
from torchrl.trainers import ReplayBufferTrainer

import torchrl_mpfa as mpfa

PAGE = Path(__file__).resolve().parents[2] / "docs/howto/torchrl_script.md"
ROWS, OBSERVED, ACTIONS = 8, 4, 2
SPEC, CHOICES = Bounded(-1.0, 1.0, (ACTIONS,)), OneHot(ACTIONS)
LARGE = 1000.0
"""Rewards next to which values of fresh networks are nothing: the TD error of a last step."""


class JointCritic(nn.Module):
    """Q(s, a) of one linear layer, or quantiles of it."""

    def __init__(self, quantiles: int = 1) -> None:
        super().__init__()
        self.layer = nn.Linear(OBSERVED + ACTIONS, quantiles)

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return self.layer(torch.cat([observation, action], dim=-1))


def policy() -> TensorDictModule:
    return TensorDictModule(
        nn.Sequential(nn.Linear(OBSERVED, ACTIONS), nn.Tanh()), ["observation"], ["action"]
    )


def stochastic(*, discrete: bool = False) -> ProbabilisticActor:
    layers = (
        nn.Linear(OBSERVED, ACTIONS)
        if discrete
        else nn.Sequential(nn.Linear(OBSERVED, 2 * ACTIONS), NormalParamExtractor())
    )
    keys = ["logits"] if discrete else ["loc", "scale"]
    return ProbabilisticActor(
        TensorDictModule(layers, ["observation"], keys),
        in_keys=keys,
        distribution_class=OneHotCategorical if discrete else TanhNormal,
        return_log_prob=True,
        spec=CHOICES if discrete else SPEC,
    )


def critic(quantiles: int = 1) -> ValueOperator:
    return ValueOperator(JointCritic(quantiles), ["observation", "action"])


def values() -> QValueActor:
    return QValueActor(nn.Linear(OBSERVED, ACTIONS), in_keys=["observation"], spec=CHOICES)


def state_values() -> ValueOperator:
    return ValueOperator(nn.Linear(OBSERVED, 1), ["observation"])


def discrete_critic(key: str = "action_value") -> TensorDictModule:
    return TensorDictModule(nn.Linear(OBSERVED, ACTIONS), ["observation"], [key])


def distribution() -> DistributionalQValueActor:
    layers = nn.Sequential(
        nn.Linear(OBSERVED, 5 * ACTIONS), nn.Unflatten(-1, (5, ACTIONS)), nn.LogSoftmax(-2)
    )
    support = torch.linspace(-2.0 * LARGE, 2.0 * LARGE, 5)
    return DistributionalQValueActor(layers, in_keys=["observation"], spec=CHOICES, support=support)


LOSSES: dict[str, Callable[[], nn.Module]] = {
    "DDPGLoss": lambda: objectives.DDPGLoss(policy(), critic()),
    "TD3Loss": lambda: objectives.TD3Loss(policy(), critic(), action_spec=SPEC),
    "TD3BCLoss": lambda: objectives.TD3BCLoss(policy(), critic(), action_spec=SPEC),
    "SACLoss": lambda: objectives.SACLoss(stochastic(), critic()),
    "DiscreteSACLoss": lambda: objectives.DiscreteSACLoss(
        stochastic(discrete=True), discrete_critic(), action_space="one-hot", num_actions=ACTIONS
    ),
    "REDQLoss": lambda: objectives.REDQLoss(stochastic(), critic()),
    "CrossQLoss": lambda: objectives.CrossQLoss(stochastic(), critic()),
    "IQLLoss": lambda: objectives.IQLLoss(stochastic(), critic(), state_values()),
    "TQCLoss": lambda: objectives.TQCLoss(stochastic(), critic(10)),
    "DiscreteIQLLoss": lambda: objectives.DiscreteIQLLoss(
        stochastic(discrete=True),
        discrete_critic("state_action_value"),
        state_values(),
        action_space="one-hot",
    ),
    "DistributionalDQNLoss": lambda: objectives.DistributionalDQNLoss(
        distribution(), gamma=0.99, delay_value=True
    ),
    "CQLLoss": lambda: objectives.CQLLoss(stochastic(), critic()),
    "DiscreteCQLLoss": lambda: objectives.DiscreteCQLLoss(values(), action_space="one-hot"),
    "DQNLoss": lambda: objectives.DQNLoss(values(), action_space="one-hot"),
}


class Row(NamedTuple):
    """What the page says of a loss."""

    td_error: str
    weighted: bool
    weighted_actor: bool
    slope: bool


def documented() -> dict[str, Row]:
    """The rows of the page by the name of the loss."""
    told = {}
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| `") and "Loss`" in cells[0]:
            weighted, actor = cells[2].startswith("yes"), "for the actor" in cells[2]
            for name in re.findall(r"`(\w+Loss)`", cells[0]):
                told[name] = Row(cells[1], weighted, actor, cells[3] == "yes")
    return told


def last_steps(name: str, weights: torch.Tensor) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    discrete = "Discrete" in name or "DQN" in name
    action = (
        torch.eye(ACTIONS)[torch.arange(ROWS) % ACTIONS]
        if discrete
        else 2 * torch.rand(ROWS, ACTIONS, generator=generator) - 1
    )
    ended = torch.ones(ROWS, 1, dtype=torch.bool)
    after = {
        "observation": torch.rand(ROWS, OBSERVED, generator=generator),
        "reward": LARGE * torch.linspace(1.0, 2.0, ROWS)[:, None],
        "done": ended,
        "terminated": ended.clone(),
    }
    return TensorDict(
        {
            "observation": torch.rand(ROWS, OBSERVED, generator=generator),
            "action": action,
            "next": after,
            "priority_weight": weights,
        },
        [ROWS],
    )


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", LOSSES)
def test_loss_of_torchrl_writes_what_the_page_says(name: str) -> None:
    torch.manual_seed(0)
    loss = LOSSES[name]()
    if name != "DistributionalDQNLoss":
        loss.make_value_estimator(gamma=0.99)
    results, errors = [], []
    for weights in (torch.ones(ROWS), torch.linspace(0.1, 2.0, ROWS)):
        steps = last_steps(name, weights)
        torch.manual_seed(1)
        results.append(loss(steps))
        errors.append(steps["td_error"].reshape(-1))
    changed = {key for key, value in results[0].items() if (value != results[1][key]).any()}
    power = float(errors[0][0].log() / torch.tensor(LARGE).log())
    kinds = {0: "a cross entropy, which serves as it is", 1: "absolute", 2: "squared"}
    kind = kinds[round(power)]
    assert power == pytest.approx(round(power), abs=0.05)
    critics = {"loss", "loss_value", "loss_qvalue"}
    assert documented()[name][:3] == (kind, bool(changed & critics), "loss_actor" in changed)


def called(name: str, rows: TensorDict) -> LossModule:
    """A loss of TorchRL's that was called with a batch."""
    torch.manual_seed(0)
    loss = LOSSES[name]()
    if name != "DistributionalDQNLoss":
        loss.make_value_estimator(gamma=0.99)
    loss(rows)
    return loss


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", LOSSES)
def test_td_error_of_each_loss_becomes_the_absolute_one(name: str) -> None:
    rows = last_steps(name, torch.ones(ROWS))
    loss = called(name, rows)
    mpfa.write_signals(rows, loss)
    found = rows["signals", "td_error"]
    assert found.shape == (ROWS,)
    if name == "DistributionalDQNLoss":  # A cross entropy.
        assert found.equal(rows["td_error"].reshape(-1))
    else:  # Next to such rewards the values are nothing.
        rewards = rows["next", "reward"].reshape(-1)
        torch.testing.assert_close(found, rewards, rtol=0.01, atol=0.0)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", LOSSES)
def test_slope_of_each_loss_is_that_of_the_first_critic_or_missing(name: str) -> None:
    rows = last_steps(name, torch.ones(ROWS))
    loss = called(name, rows)
    mpfa.write_signals(rows, loss)
    has_slope = ("signals", "action_gradient") in rows.keys(True)
    assert has_slope == documented()[name].slope
    if not has_slope:
        return
    weights = loss.value_network_params if name == "DDPGLoss" else loss.qvalue_network_params[0]
    # The critic is linear: its slope is the weight of the action, the mean of all quantiles'.
    layer = weights["module", "layer", "weight"].detach()
    slope = layer[:, OBSERVED:].mean(0).norm().expand(ROWS)
    torch.testing.assert_close(rows["signals", "action_gradient"], slope)


@pytest.mark.filterwarnings("ignore")
def test_slope_changes_neither_a_batch_normalization_nor_the_random_numbers() -> None:
    layers = nn.Sequential(
        nn.Linear(OBSERVED + ACTIONS, 8), nn.BatchNorm1d(8), nn.Dropout(0.5), nn.Linear(8, 1)
    )

    class Joint(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layers = layers

        def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
            return self.layers(torch.cat([observation, action], dim=-1))

    loss = objectives.CrossQLoss(stochastic(), ValueOperator(Joint(), ["observation", "action"]))
    loss.make_value_estimator(gamma=0.99)
    rows = last_steps("CrossQLoss", torch.ones(ROWS))
    loss(rows)
    training = [module.training for module in loss.modules()]
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    random = torch.get_rng_state()
    mpfa.write_signals(rows, loss)
    assert all(value.equal(before[name]) for name, value in loss.state_dict().items())
    assert random.equal(torch.get_rng_state())
    assert training == [module.training for module in loss.modules()]


def test_page_has_a_row_for_each_loss_with_a_critic() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        there = {name for name in dir(objectives) if re.fullmatch(r"\w+Loss", name)}
    off_policy = {"DDPG", "TD3", "TD3BC", "SAC", "DiscreteSAC", "REDQ", "CrossQ", "IQL", "CQL"}
    off_policy |= {"DiscreteIQL", "DiscreteCQL", "DQN", "DistributionalDQN", "TQC"}
    others = {"ACT", "BC", "DT", "OnlineDT", "DiffusionBC", "GAIL", "RND", "WorldModel", "QMixer"}
    on_policy = {"A2C", "PPO", "ClipPPO", "KLPENPPO", "IPPO", "MAPPO", "Reinforce"}
    known = {f"{name}Loss" for name in off_policy | others | on_policy}
    assert {name for name in there if not name.startswith("Dreamer")} == known
    assert documented().keys() == {f"{name}Loss" for name in off_policy}
    assert documented().keys() == LOSSES.keys()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "signals"),
    [
        *((name, None) for name in ("DDPGLoss", "TD3Loss", "TD3BCLoss", "SACLoss", "REDQLoss")),
        *((name, None) for name in ("CrossQLoss", "IQLLoss", "CQLLoss")),
        *((name, ["reward", "td_error"]) for name in ("DiscreteSACLoss", "DQNLoss")),
    ],
)
def test_buffer_of_a_script_changes_to_ours_as_the_page_says(
    name: str, signals: list[str] | None
) -> None:
    """The batch of a trainer, as in redq, and that of a loop; rows as those of a data set."""
    theirs = TensorDictReplayBuffer(storage=LazyTensorStorage(ROWS), batch_size=ROWS)
    theirs.extend(last_steps(name, torch.ones(ROWS)).exclude("priority_weight"))
    options = {} if signals is None else {"signals": signals}
    buffer = mpfa.SignalReplayBuffer(
        storage=LazyTensorStorage(ROWS), sampler=mpfa.MPFASampler(**options), batch_size=ROWS
    )
    buffer.extend(theirs[:])
    hook = ReplayBufferTrainer(buffer, ROWS)
    batch = hook.sample(buffer[:])
    loss = called(name, batch)
    mpfa.write_signals(batch, loss)
    before = buffer.distributions()["priority"].clone()
    hook.update_priority(batch)
    assert not before.equal(buffer.distributions()["priority"])
    # Their own line of the loop lacks the priority.
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'priority'"):
        theirs.update_priority(batch)
