"""DQN, against plain loops."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict

from torchrl_mpfa import (
    DQN,
    Learner,
    make_value_network,
)
from torchrl_mpfa.selection import SampledBatch

ACTIONS, SIZE, GAMMA, SCALE = 5, 4, 0.9, 0.1


def transitions(count=12, seed=0):
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randint(ACTIONS, (count,), generator=generator)
    end = torch.rand(count, 1, generator=generator) < 0.3
    return TensorDict(
        {
            "observation": torch.rand(count, SIZE, generator=generator),
            "action": torch.nn.functional.one_hot(chosen, ACTIONS),
            "priority_weight": torch.rand(count, generator=generator) + 0.1,
            "next": {
                "observation": torch.rand(count, SIZE, generator=generator),
                "reward": torch.randn(count, 1, generator=generator) * 5,
                "done": end,
                "terminated": end,
            },
        },
        [count],
    )


def network(seed=0):
    torch.manual_seed(seed)
    return make_value_network(SIZE, ACTIONS, width=8, final_init=None)


def make_dqn():
    return DQN(network(), lr=0.01)


@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("importance", ["critic", "torchrl", "none"])
def test_update_of_dqn_is_that_of_a_plain_loop(double, importance):
    online, target = network(0), network(0)
    options = {"double": double, "reward_scale": SCALE, "importance": importance}
    learner = DQN(network(0), gamma=GAMMA, lr=0.01, tau=0.25, **options)
    optimizer = torch.optim.Adam(online.parameters(), lr=0.01)
    for seed in range(3):
        batch = transitions(seed=seed)
        terms, errors = [], []
        for row in batch:
            value = online.module(row["observation"])[0][row["action"].argmax()]
            after = row["next", "observation"]
            chooser = online if double else target
            choice = chooser.module(after)[0].argmax()
            ahead = target.module(after)[0][choice].detach()
            goes_on = 1.0 - float(row["next", "terminated"])
            error = SCALE * row["next", "reward"] + GAMMA * goes_on * ahead - value
            weight = 1.0 if importance == "none" else row["priority_weight"]
            if importance == "torchrl":
                weight = weight / batch["priority_weight"].mean()
            terms.append(weight * error**2)
            errors.append(error.abs().item() / SCALE)
        expected = torch.stack(terms).mean()
        optimizer.zero_grad()
        expected.backward()
        optimizer.step()
        with torch.no_grad():
            for mine, yours in zip(target.parameters(), online.parameters(), strict=True):
                mine.mul_(0.75).add_(yours, alpha=0.25)
        log = learner.update(batch)
        assert log["loss_value"].item() == pytest.approx(expected.item(), rel=1e-4)
        assert batch["signals", "td_error"].tolist() == pytest.approx(errors, rel=1e-3)
    for mine, theirs in zip(online.parameters(), learner.policy.parameters(), strict=True):
        assert torch.allclose(mine, theirs, atol=1e-4)


def test_learner_with_a_loaded_state_learns_like_the_saved_one():
    first, second = make_dqn(), make_dqn()
    assert isinstance(first, Learner)
    first.anneal(0.5)
    first.update(transitions())
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    second.anneal(0.5)
    for each in (first, second):
        each.update(transitions(seed=1))
    assert first.updates == second.updates == 2
    seen = {"observation": torch.rand(6, SIZE)}
    values = [each.policy.outputs(seen)["action_value"] for each in (first, second)]
    assert torch.equal(*values)
    assert values[0].abs().max() > 0


def test_bad_batch_or_state_is_rejected_and_changes_nothing():
    learner = make_dqn()
    before = copy.deepcopy(learner.state_dict())
    spoiled = transitions()
    spoiled["next", "reward"][3] = torch.nan
    with pytest.raises(ValueError, match="reward"):
        learner.update(spoiled)
    spoiled = transitions()
    spoiled["priority_weight"][2] = torch.nan
    with pytest.raises(ValueError, match=r"nan in 'priority_weight', row 2"):
        learner.update(spoiled)
    for wrong in ({"trains": "critic"}, {"loss_function": "pal"}):
        with pytest.raises(ValueError, match="one network"):
            learner.update(SampledBatch(transitions(), **wrong))
    with pytest.raises(ValueError, match="factor"):
        learner.anneal(1.5)
    for missing in ("action", ("next", "terminated")):
        with pytest.raises(KeyError, match=r"action|terminated"):
            learner.update(transitions().exclude(missing))
    with pytest.raises(ValueError, match=r"the saved learner.* lacks"):
        learner.load_state_dict({"networks": {}, "updates": 3})
    other = make_dqn()
    other.update(transitions())
    with pytest.raises(ValueError, match="the saved learner, 'updates' must be 0, got 'some'"):
        learner.load_state_dict({**other.state_dict(), "updates": "some"})
    after = learner.state_dict()
    assert after["updates"] == 0
    assert all(
        torch.equal(before["networks"][key], after["networks"][key]) for key in before["networks"]
    )


@pytest.mark.parametrize("form", ["booleans", "floats", "column", "numbers", "column of floats"])
def test_every_form_of_an_action_is_learned_from_alike(form):
    batch, other = transitions(), transitions()
    hot = batch["action"]
    number = hot.argmax(-1)
    other["action"] = {
        "booleans": hot.bool(),
        "floats": hot.float(),
        "column": number.unsqueeze(1),
        "numbers": number,
        "column of floats": number.float().unsqueeze(1),
    }[form]
    for each in (batch, other):
        make_dqn().update(each)
    assert torch.equal(batch["signals", "td_error"], other["signals", "td_error"])


@pytest.mark.parametrize(
    "spoil",
    [
        lambda hot: hot / ACTIONS,
        lambda hot: hot * 2,
        lambda hot: hot * 0,
        lambda hot: hot + hot.roll(1, -1),
        lambda hot: hot[:, 1:],
        lambda hot: torch.nn.functional.pad(hot, (0, 1)),
        lambda hot: hot.argmax(-1) + ACTIONS,
        lambda hot: hot.argmax(-1).neg() - 1,
        lambda hot: hot.argmax(-1) + 0.5,
        lambda hot: hot[:, :1].bool(),
    ],
)
def test_bad_action_is_rejected_by_name_and_changes_nothing(spoil):
    learner = make_dqn()
    before, batch = copy.deepcopy(learner.state_dict()["networks"]), transitions()
    batch["action"] = spoil(batch["action"])
    with pytest.raises(ValueError, match=f"action must be one-hot among {ACTIONS}"):
        learner.update(batch)
    after = learner.state_dict()["networks"]
    assert all(torch.equal(before[key], after[key]) for key in before)


def test_transitions_of_several_steps_are_discounted_by_all_of_them():
    learner = make_dqn()
    learner.update(transitions(seed=5))  # Values that are not zero.
    batch = transitions()
    batch["steps_to_next_obs"] = torch.arange(1, 13).reshape(-1, 1)
    seen = {"observation": batch["next", "observation"]}
    with torch.no_grad():
        best = learner.policy.outputs(seen)["action"]
        ahead = (learner.targets["value"]).outputs(seen)
        ahead = ahead["action_value"]
        here = learner.policy.outputs({"observation": batch["observation"]})["action_value"]
    expected = []
    for row in range(12):
        value = float(here[row][batch["action"][row].argmax()])
        goes_on = not bool(batch["next", "terminated"][row])
        bootstrap = float(ahead[row][best[row].argmax()]) * 0.99 ** (row + 1) * goes_on
        expected.append(abs(float(batch["next", "reward"][row]) + bootstrap - value))
    learner.update(batch)
    assert batch["signals", "td_error"].tolist() == pytest.approx(expected, abs=1e-4)
