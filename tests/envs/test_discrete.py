"""Choices among pairs of wheel speeds, the cells of a table, and policies made of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from mpfa_envs import (
    DiscreteWheels,
    Mirror,
    NavigationTorchEnv,
    Policy,
    RandomMirror,
    load_policy,
    save_policy,
)
from mpfa_envs.policies.layers import Choice, Linear, Table
from mpfa_envs.robots.discrete import WHEEL_PAIRS
from mpfa_envs.sensing.observation import Binning, observation_slices


@pytest.mark.parametrize("num_envs", [None, 3])
def test_the_specs_of_the_transformed_environment_hold(num_envs):
    env = TransformedEnv(
        NavigationTorchEnv(num_envs=num_envs, world="B", physics="kinematic"), DiscreteWheels()
    )
    check_env_specs(env, seed=0)
    batch = [] if num_envs is None else [num_envs]
    assert [*env.action_spec.shape] == [*batch, len(WHEEL_PAIRS)]
    assert env.rand_action()["action"].sum(-1).eq(1).all()
    env.close()


NUMBERS = torch.tensor([5, 2])
HOT = torch.nn.functional.one_hot(NUMBERS, len(WHEEL_PAIRS))
SOFT = torch.full((2, len(WHEEL_PAIRS)), 1.0 / len(WHEEL_PAIRS))


@pytest.mark.parametrize(
    "form", [HOT, HOT.bool(), HOT.float(), NUMBERS, NUMBERS.unsqueeze(1), NUMBERS.float()]
)
def test_every_form_of_a_choice_drives_its_pair_and_is_mirrored(form):
    rows = TensorDict({"action": form, "observation": torch.rand(2, 24)}, [2])
    rows["next"] = {"observation": torch.rand(2, 24)}
    driven = DiscreteWheels().inv(rows)["action"]
    assert driven.tolist() == [[*WHEEL_PAIRS[5]], [*WHEEL_PAIRS[2]]]
    mirrored = RandomMirror(chance=1.0, pairs=WHEEL_PAIRS)(rows.clone())
    assert mirrored["action"].shape == form.shape and mirrored["action"].dtype is form.dtype
    assert DiscreteWheels().inv(mirrored)["action"].equal(driven.flip(1))


@pytest.mark.parametrize(
    "form",
    [
        SOFT,
        HOT * 2,
        HOT.roll(1, 0) + HOT,
        HOT * 0,
        HOT[:, :6],
        torch.nn.functional.pad(HOT, (0, 1)),
        torch.tensor([7, 0]),
        torch.tensor([[-1], [0]]),
        torch.tensor([[0.5], [0.0]]),
        torch.tensor([[torch.nan], [0.0]]),
    ],
)
def test_what_is_no_choice_is_rejected_by_name(form):
    with pytest.raises(ValueError, match=r"action must be one-hot, shape \[..., 7\]"):
        DiscreteWheels().inv(TensorDict({"action": form}, [2]))


@pytest.mark.parametrize("width", [1, 3])
def test_actions_of_another_width_are_neither_mirrored_nor_driven(width):
    with pytest.raises(ValueError, match="action must have the shape"):
        Mirror().action(torch.zeros(2, width))
    env = NavigationTorchEnv(num_envs=2, world="A", physics="kinematic")
    state = env.reset().set("action", torch.zeros(2, width))
    with pytest.raises(ValueError, match=r"action must have shape \[2, 2\]"):
        env.step(state)
    env.close()


def test_a_cell_is_that_of_a_plain_loop():
    binning = Binning(groups=3, closeness=(0.25, 0.6), directions=8, distances=(0.1, 0.4))
    rng = np.random.default_rng(0)
    seen = rng.uniform(0.0, 1.0, (200, 24)).astype(np.float32)
    angle = rng.uniform(-math.pi, math.pi, 200)
    parts = observation_slices()
    seen[:, parts["goal_direction"]] = np.stack([np.cos(angle), np.sin(angle)], 1)
    found = binning(seen)
    for row, turn, cell in zip(seen, angle, found, strict=True):
        places = []
        for first in (0, 6, 12):
            nearest = max(row[first : first + 6])
            places.append(sum(nearest >= bound for bound in (0.25, 0.6)))
        width = 2 * math.pi / 8
        places.append(math.floor(turn / width + 0.5) % 8)
        distance = row[parts["goal_distance"].start]
        places.append(sum(distance >= bound for bound in (0.1, 0.4)))
        expected = 0
        for place, size in zip(places, (3, 3, 3, 8, 3), strict=True):
            expected = expected * size + place
        assert cell == expected
    assert len(set(found.tolist())) > 30
    assert binning.cells == 27 * 8 * 3 > found.max()


def table(**changes):
    binning = Binning(directions=4)
    values = np.random.default_rng(1).normal(size=(binning.cells, len(WHEEL_PAIRS)))
    fields = {name: getattr(binning, name) for name in binning.__dataclass_fields__}
    return Table(values.astype(np.float32), **{**fields, **changes})


@pytest.mark.parametrize("kind", ["table", "linear"])
def test_a_saved_policy_of_choices_drives_its_best_pair(tmp_path, kind):
    rng = np.random.default_rng(2)
    first = table()
    if kind == "linear":
        weight = rng.normal(size=(len(WHEEL_PAIRS), 24)).astype(np.float32)
        first = Linear(weight, np.zeros(len(WHEEL_PAIRS), np.float32))
    policy = Policy([first, Choice(np.array(WHEEL_PAIRS, np.float32))])
    again = load_policy(save_policy(policy, tmp_path))
    assert (again.observation_size, again.action_size) == (24, 2)
    seen = rng.uniform(-1.0, 1.0, (40, 24)).astype(np.float32)
    values = first.values[first.binning(seen)] if kind == "table" else seen @ first.weight.T
    expected = [WHEEL_PAIRS[place] for place in values.argmax(1)]
    for each in (policy, again):
        assert np.allclose(each(seen), expected)
    assert len(set(expected)) > 3


@pytest.mark.parametrize(
    ("layers", "word"),
    [
        ([Choice(np.ones((7, 2), np.float32))], "begin"),
        ([table(), Choice(np.ones((5, 2), np.float32))], r"\[7, A\]"),
        ([table(), table()], "first"),
        ([table(directions=5)], "values must have shape"),
    ],
)
def test_layers_that_do_not_fit_are_rejected(layers, word):
    with pytest.raises(ValueError, match=word):
        Policy(layers)
