"""Policies and noise on tensors: to the bit what TorchRL's modules make of tensordicts."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule

from torchrl_mpfa import (
    GaussianNoise,
    make_actor,
    make_critic,
    make_stochastic_actor,
    make_value_network,
)

LOW, HIGH = torch.tensor([-2.0, 0.0]), torch.tensor([0.5, 10.0])
SPECS: dict[str, Any] = {
    "unit": Bounded(-1.0, 1.0, (2,)),
    "each": Bounded(LOW, HIGH, (2,)),
    "within": Composite(action=Bounded(-0.1, 0.1, (2,))),
    "free": Unbounded((2,)),
}
RANDOM = ExplorationType.RANDOM


def seeded(seed: int, call: Any, *arguments: Any, **options: Any) -> torch.Tensor:
    """Call with a state of the generator that follows from the seed."""
    torch.manual_seed(seed)
    found: torch.Tensor = call(*arguments, **options)
    return found


def in_tensordict(policy: Any, seen: torch.Tensor) -> torch.Tensor:
    with set_exploration_type(RANDOM), torch.no_grad():
        action: torch.Tensor = policy(TensorDict({"observation": seen}, [len(seen)]))["action"]
    return action


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@pytest.mark.parametrize("robots", [1, 16])
@pytest.mark.parametrize(("first", "last"), [(1.0, 0.2), (0.3, 0.3), (0.5, 0.0)])
def test_noise_is_torchrls_to_the_bit(spec: Any, robots: int, first: float, last: float) -> None:
    of_actor = spec if isinstance(spec, Bounded) else None
    actor = make_actor(5, 2, action_spec=of_actor, width=8, final_init=1.0)
    theirs = AdditiveGaussianModule(spec, first, last, 20)
    ours = GaussianNoise(spec, first, last, 20)
    policies = [TensorDictSequential(actor, noise) for noise in (theirs, ours)]
    for number, seen in enumerate(torch.rand(25, robots, 5)):
        expected = seeded(number, in_tensordict, policies[0], seen)
        assert torch.equal(seeded(number, in_tensordict, policies[1], seen), expected)
        assert torch.equal(seeded(number, ours.noisy, actor.act(seen)), expected)
        theirs.step(robots)
        ours.step(robots)
        assert torch.equal(ours.sigma, theirs.sigma)
    assert ours.sigma.item() == pytest.approx(last)


def test_bounds_of_a_batch_of_environments_are_those_of_the_noise() -> None:
    spec = Bounded(-0.5, 0.5, (3, 2))
    theirs, ours = AdditiveGaussianModule(spec, 2.0, 0.1), GaussianNoise(spec, 2.0, 0.1)
    action = torch.rand(3, 2)
    with set_exploration_type(RANDOM):
        expected = seeded(0, theirs, TensorDict({"action": action}))["action"]
    found = seeded(0, ours.noisy, action)
    assert torch.equal(found, expected)
    assert found.abs().max() == 0.5


def test_noise_in_double_precision_is_torchrls() -> None:
    action = torch.rand(20, 2, dtype=torch.double)
    spec = Bounded(-1.0, 1.0, (2,), dtype=torch.double)
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.double)
    try:
        modules = [kind(spec, 0.7, 0.1, 30) for kind in (AdditiveGaussianModule, GaussianNoise)]
        for frames in (1, 7, 40):
            with set_exploration_type(RANDOM):
                expected = seeded(frames, modules[0], TensorDict({"action": action}))["action"]
            found = seeded(frames, modules[1].noisy, action)
            assert found.dtype == torch.double
            assert torch.equal(found, expected)
            for module in modules:
                module.step(frames)
            assert torch.equal(modules[0].sigma, modules[1].sigma)
    finally:
        torch.set_default_dtype(before)


def test_noise_on_tensordicts_stops_where_exploration_does() -> None:
    noise, action = GaussianNoise(SPECS["unit"]), torch.zeros(3, 2)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(noise(TensorDict({"action": action}))["action"], action)
    assert not torch.equal(noise(TensorDict({"action": action}))["action"], action)
    spec, key = Composite(agents=Composite(action=SPECS["unit"])), ("agents", "action")
    moved = GaussianNoise(spec, action_key=key)(TensorDict({key: action}))
    assert not torch.equal(moved[key], action)


def test_noise_keeps_to_the_spec_that_it_has() -> None:
    noise = GaussianNoise(SPECS["unit"], 5.0, 1.0)
    action = torch.zeros(50, 2)
    assert noise.noisy(action).abs().max() == 1.0
    noise.spec = Bounded(-0.5, 0.5, (2,))
    for each in (noise, copy.deepcopy(noise), pickle.loads(pickle.dumps(noise))):
        assert each.noisy(action).abs().max() == 0.5


def test_noise_without_a_spec_asks_for_one() -> None:
    noise = GaussianNoise()
    with pytest.raises(ValueError, match="spec must be an action spec, got None: set it"):
        noise.noisy(torch.zeros(2))
    noise.spec = SPECS["unit"]
    assert noise.noisy(torch.zeros(2)).shape == (2,)


def test_saved_noise_is_that_of_torchrl() -> None:
    theirs, ours = AdditiveGaussianModule(SPECS["unit"], 1.0, 0.1), GaussianNoise(SPECS["unit"])
    theirs.step(300)
    ours.load_state_dict(theirs.state_dict())
    assert torch.equal(ours.sigma, theirs.sigma)


@pytest.mark.parametrize("robots", [1, 16])
@pytest.mark.parametrize("limit", [None, 1.5])
@pytest.mark.parametrize("bounds", [None, SPECS["each"]])
def test_policies_choose_on_tensors_what_they_choose_on_tensordicts(
    robots: int, limit: float | None, bounds: Any
) -> None:
    options: dict[str, Any] = {"action_spec": bounds, "saturation_limit": limit, "width": 8}
    options["final_init"] = 1.0
    deterministic, stochastic = make_actor(5, 2, **options), make_stochastic_actor(5, 2, **options)
    values = make_value_network(5, 4, width=8, final_init=1.0)
    for number, seen in enumerate(torch.randn(20, robots, 5)):
        assert torch.equal(deterministic.act(seen), in_tensordict(deterministic, seen))
        assert torch.equal(values.act(seen), in_tensordict(values, seen))
        sampled = seeded(number, stochastic.sample, {"observation": seen})
        found = seeded(number, stochastic.act, seen, random=True)
        assert torch.equal(found, sampled[0])
        assert torch.equal(found, seeded(number, in_context, stochastic, seen))
        composed = seeded(number, in_tensordict, stochastic, seen)
        torch.testing.assert_close(found, composed)  # TorchRL adds in another order.
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            mean = stochastic.outputs({"observation": seen})["action"]
        assert torch.equal(stochastic.act(seen), mean)


def in_context(policy: Any, seen: torch.Tensor) -> torch.Tensor:
    with set_exploration_type(RANDOM):
        action: torch.Tensor = policy.outputs({"observation": seen})["action"]
    return action


def test_what_acts_has_no_gradients_and_is_a_policy() -> None:
    seen = torch.rand(1, 5)
    assert not make_actor(5, 2).act(seen).requires_grad
    assert not make_stochastic_actor(5, 2).act(seen, random=True).requires_grad
    with pytest.raises(KeyError, match="action"):
        make_critic(5, 2).act(seen, torch.rand(1, 2))
    with pytest.raises(ValueError, match="argument"):
        make_actor(5, 2).act(seen, seen)
