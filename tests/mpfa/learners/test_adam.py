"""Adam and target networks on one tensor for each group of parameters."""

from copy import deepcopy

import pytest
import torch

from tests.mpfa.compiled import UNTRACED, assert_alike, make_pair, update_both
from tests.mpfa.learning import make_batch, make_learner
from torchrl_mpfa.learners.adam import FlatAdam

EAGER_AND_COMPILED = pytest.mark.parametrize("compile", [False, UNTRACED], ids=["eager", "program"])


def make_tensors():
    torch.manual_seed(0)
    return [torch.randn(shape).requires_grad_() for shape in ((3, 5), (7,), ())]


def give_gradients(tensors, seed, *, without=()):
    torch.manual_seed(seed)
    for place, tensor in enumerate(tensors):
        gradient = torch.randn_like(tensor)
        tensor.grad = None if place in without else gradient


@pytest.mark.parametrize("without", [(), (1,), (0, 1, 2)], ids=str)
def test_steps_and_states_are_those_of_pytorchs_adam(without):
    ours, theirs = make_tensors(), make_tensors()
    flat = FlatAdam([{"params": ours, "lr": 0.1, "weight_decay": 0.01}])
    flat.flatten({})
    plain = torch.optim.Adam(theirs, lr=0.1, weight_decay=0.01, fused=True)
    for seed in range(6):
        for tensors, optimizer in ((ours, flat), (theirs, plain)):
            give_gradients(tensors, seed, without=without if seed == 2 else ())
            optimizer.step()
    torch.testing.assert_close(ours, theirs)
    found, expected = flat.state_dict()["state"], plain.state_dict()["state"]
    assert found.keys() == expected.keys()
    for place, state in expected.items():
        assert found[place].keys() == state.keys()
        torch.testing.assert_close(found[place], state)
    states = deepcopy(flat.state_dict()), deepcopy(plain.state_dict())
    plain.load_state_dict(states[0])  # Each reads the states of the other.
    flat.load_state_dict(states[1])
    for tensors, optimizer in ((ours, flat), (theirs, plain)):
        give_gradients(tensors, 9)
        optimizer.step()
    torch.testing.assert_close(ours, theirs)


@EAGER_AND_COMPILED
def test_parameters_of_a_group_lie_in_one_tensor_and_so_do_its_targets(compile):
    learner = make_learner(compile=compile)
    for seed in range(2):
        learner.update(make_batch(seed=seed))
    for parts in (learner.networks, learner.targets):
        for name in ("actor", "critics"):
            found = list(parts[name].parameters())
            assert len(found) > 5
            assert len({value.untyped_storage().data_ptr() for value in found}) == 1


def test_program_leaves_the_steps_to_an_optimizer_that_somebody_looks_at():
    learners, steps = make_pair("ddpg"), []
    update_both(learners, 0)
    hook = learners[1].optimizer.register_step_post_hook(lambda *given: steps.append(given))
    with pytest.warns(UserWarning, match="steps of the FlatAdam are not compiled"):
        update_both(learners, 1)
    for seed in range(2, 4):  # A second warning would be an error.
        update_both(learners, seed, trains="critic")
    assert len(steps) == 3
    hook.remove()
    update_both(learners, 4)
    assert len(steps) == 3
    assert_alike(*learners)


def test_program_leaves_the_steps_to_an_optimizer_of_another_kind():
    learners = make_pair("ddpg")
    for learner in learners:
        learner.optimizer = torch.optim.SGD(learner.networks.parameters(), lr=0.1)
    before = [value.clone() for value in learners[1].networks.parameters()]
    with pytest.warns(UserWarning, match="steps of the SGD are not compiled"):
        update_both(learners, 0)
    for seed in range(1, 3):
        update_both(learners, seed)
    assert_alike(*learners)
    assert not any(map(torch.equal, before, learners[1].networks.parameters()))
