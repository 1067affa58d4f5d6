"""DQN and Q learning, against plain loops."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict

from torchrl_mpfa import (
    DQN,
    Learner,
    make_value_network,
    run_updates,
)
from torchrl_mpfa.learners import TabularQLearner
from torchrl_mpfa.methods import make_replay
from torchrl_mpfa.networks import make_value_table
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


def test_huber_loss_bends_at_one_in_units_of_the_reward():
    batch = transitions()
    batch["next", "reward"] *= 0.5
    squares = batch.clone()
    torch.manual_seed(0)
    options = {"reward_scale": 0.5, "importance": "none", "gamma": GAMMA}
    DQN(network(), loss_function="l2", **options).update(squares)
    unit = 0.5
    expected = [
        0.5 * size**2 if size < unit else unit * (size - 0.5 * unit)
        for size in (0.5 * squares["signals", "td_error"]).tolist()
    ]
    assert min(expected) < 0.5 * unit**2 < max(expected)
    found = DQN(network(), loss_function="smooth_l1", **options).update(batch)["loss_value"]
    assert float(found) == pytest.approx(sum(expected) / 12, rel=1e-4)
    torch.testing.assert_close(batch["signals", "td_error"], squares["signals", "td_error"])


def cell_of(observation):
    return (observation[..., 0] * 3).long()


@pytest.mark.parametrize("importance", [True, False])
def test_update_of_the_table_is_that_of_a_plain_dict(importance):
    learner = TabularQLearner(
        make_value_table(cell_of, 3, ACTIONS), lr=0.5, gamma=GAMMA, importance=importance
    )
    table = {(cell, action): 0.0 for cell in range(3) for action in range(ACTIONS)}
    for seed in range(4):
        batch, moves, errors = transitions(30, seed=seed), {}, []
        for row in batch:
            cell, then = int(cell_of(row["observation"])), int(cell_of(row["next", "observation"]))
            ahead = max(table[then, action] for action in range(ACTIONS))
            goes_on = not bool(row["next", "terminated"])
            entry = cell, int(row["action"].argmax())
            error = float(row["next", "reward"]) + GAMMA * ahead * goes_on - table[entry]
            weight = float(row["priority_weight"]) if importance else 1.0
            moves.setdefault(entry, []).append(weight * error)
            errors.append(abs(error))
        for entry, steps in moves.items():
            table[entry] += 0.5 * sum(steps) / len(steps)
        learner.update(SampledBatch(batch))
        assert batch["signals", "td_error"].tolist() == pytest.approx(errors, abs=1e-4)
    for (cell, action), value in table.items():
        assert learner.table[cell, action].item() == pytest.approx(value, abs=1e-4)


def learners():
    return [
        DQN(network(), lr=0.01),
        TabularQLearner(make_value_table(cell_of, 3, ACTIONS)),
    ]


@pytest.mark.parametrize("kind", [0, 1])
def test_learner_with_a_loaded_state_learns_like_the_saved_one(kind):
    first, second = learners()[kind], learners()[kind]
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


@pytest.mark.parametrize("kind", [0, 1])
def test_bad_batch_or_state_is_rejected_and_changes_nothing(kind):
    learner = learners()[kind]
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
    other = learners()[kind]
    other.update(transitions())
    with pytest.raises(ValueError, match="the saved learner, 'updates' must be 0, got 'some'"):
        learner.load_state_dict({**other.state_dict(), "updates": "some"})
    after = learner.state_dict()
    assert after["updates"] == 0
    assert all(
        torch.equal(before["networks"][key], after["networks"][key]) for key in before["networks"]
    )


@pytest.mark.parametrize("kind", [0, 1])
def test_ends_that_are_bytes_count_as_booleans(kind):
    batch, numbers = transitions(), transitions()
    for key in ("done", "terminated"):
        numbers["next", key] = numbers["next", key].to(torch.uint8)
    for each in (batch, numbers):
        learners()[kind].update(each)
    assert torch.equal(batch["signals", "td_error"], numbers["signals", "td_error"])


@pytest.mark.parametrize("kind", [0, 1])
@pytest.mark.parametrize("form", ["booleans", "floats", "column", "numbers", "column of floats"])
def test_every_form_of_an_action_is_learned_from_alike(kind, form):
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
        learners()[kind].update(each)
    assert torch.equal(batch["signals", "td_error"], other["signals", "td_error"])


@pytest.mark.parametrize("kind", [0, 1])
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
def test_bad_action_is_rejected_by_name_and_changes_nothing(kind, spoil):
    learner = learners()[kind]
    before, batch = copy.deepcopy(learner.state_dict()["networks"]), transitions()
    batch["action"] = spoil(batch["action"])
    with pytest.raises(ValueError, match=f"action must be one-hot among {ACTIONS}"):
        learner.update(batch)
    after = learner.state_dict()["networks"]
    assert all(torch.equal(before[key], after[key]) for key in before)


@pytest.mark.parametrize("kind", [0, 1])
def test_transitions_of_several_steps_are_discounted_by_all_of_them(kind):
    learner = learners()[kind]
    learner.update(transitions(seed=5))  # Values that are not zero.
    batch = transitions()
    batch["steps_to_next_obs"] = torch.arange(1, 13).reshape(-1, 1)
    seen = {"observation": batch["next", "observation"]}
    with torch.no_grad():
        best = learner.policy.outputs(seen)["action"]
        ahead = (learner.targets["value"] if kind == 0 else learner.policy).outputs(seen)
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


@pytest.mark.parametrize("kind", [0, 1])
def test_learner_learns_which_action_pays_with_mpfa_per_of_two_signals(kind):
    replay = make_replay(
        "mpfa_per", capacity=200, batch_size=32, signals=["reward", "td_error"],
        generator=torch.Generator().manual_seed(0),
    )  # fmt: skip
    rows = transitions(200)
    rows["next", "reward"] = rows["action"][:, 2:3].float()
    rows["next", "terminated"][:] = True
    replay.buffer.extend(rows.exclude("priority_weight"))
    learner = learners()[kind]
    for _ in range(60):
        run_updates(replay.buffer, learner, replay.select, updates=4)
    found = learner.policy.outputs({"observation": torch.rand(50, SIZE)})
    assert (found["action"].argmax(-1) == 2).all()
    assert (found["action"].sum(-1) == 1).all()
    assert torch.equal(found["chosen_action_value"], found["action_value"].amax(-1, keepdim=True))


def test_rate_of_a_table_follows_annealing():
    learner = TabularQLearner(make_value_table(cell_of, 3, ACTIONS), lr=0.5)
    row = transitions(1).exclude("priority_weight")
    row["next", "reward"][:], row["next", "terminated"][:] = 8.0, True
    for fraction, expected in ((1.0, 4.0), (0.25, 4.0 + 0.125 * 4.0), (0.0, 4.5)):
        learner.anneal(fraction)
        learner.update(row)
        assert float(learner.table.sum()) == pytest.approx(expected)
