"""Q learning of a table, against a plain dict."""

from __future__ import annotations

import copy

import pytest
import torch

from tests.mpfa.learners.test_dqn import ACTIONS, GAMMA, SIZE, transitions
from torchrl_mpfa import Learner, make_value_network
from torchrl_mpfa.selection import SampledBatch
from training.run.q_learning import TabularQLearner, make_value_table


def cell_of(observation):
    return (observation[..., 0] * 3).long()


def make_table(**given):
    return TabularQLearner(make_value_table(cell_of, 3, ACTIONS), **given)


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


def test_learner_with_a_loaded_state_learns_like_the_saved_one():
    first, second = make_table(), make_table()
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
    learner = make_table()
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
    other = make_table()
    other.update(transitions())
    with pytest.raises(ValueError, match="the saved learner, 'updates' must be 0, got 'some'"):
        learner.load_state_dict({**other.state_dict(), "updates": "some"})
    after = learner.state_dict()
    assert after["updates"] == 0
    assert all(
        torch.equal(before["networks"][key], after["networks"][key]) for key in before["networks"]
    )


def test_transitions_of_several_steps_are_discounted_by_all_of_them():
    learner = make_table()
    learner.update(transitions(seed=5))  # Values that are not zero.
    batch = transitions()
    batch["steps_to_next_obs"] = torch.arange(1, 13).reshape(-1, 1)
    seen = {"observation": batch["next", "observation"]}
    with torch.no_grad():
        best = learner.policy.outputs(seen)["action"]
        ahead = learner.policy.outputs(seen)
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


def test_rate_of_a_table_follows_annealing():
    learner = TabularQLearner(make_value_table(cell_of, 3, ACTIONS), lr=0.5)
    row = transitions(1).exclude("priority_weight")
    row["next", "reward"][:], row["next", "terminated"][:] = 8.0, True
    for fraction, expected in ((1.0, 4.0), (0.25, 4.0 + 0.125 * 4.0), (0.0, 4.5)):
        learner.anneal(fraction)
        learner.update(row)
        assert float(learner.table.sum()) == pytest.approx(expected)


def test_argument_out_of_range_is_rejected_by_name():
    with pytest.raises(ValueError, match="lr must be in"):
        make_table(lr=0.0)
    for name in ("cells", "actions"):
        with pytest.raises(ValueError, match=f"{name} must be an integer from 1"):
            make_value_table(**{"cell_of": len, "cells": 3, "actions": 2, name: 0})
    with pytest.raises(TypeError, match="policy must be one of make_value_table"):
        TabularQLearner(make_value_network(4, 5))
