"""TD3Learner: the delay of actor and targets, and going on from a state."""

from copy import deepcopy

import torch

from tests.mpfa.losses import BOUNDS, GAMMA, make_batch, make_networks
from torchrl_mpfa import TD3Learner, make_td3_loss


def make_learner(**kwargs):
    loss = make_td3_loss(*make_networks(), gamma=GAMMA, bounds=BOUNDS)
    return TD3Learner(loss, **{"actor_lr": 1e-3, "critic_lr": 1e-3, **kwargs})


def test_the_actor_and_the_targets_move_at_every_second_update_only():
    learner = make_learner()
    values = {**dict(learner.loss.named_parameters()), **dict(learner.loss.named_buffers())}
    for update in range(1, 5):
        before = {name: value.detach().clone() for name, value in values.items()}
        log = learner.update(make_batch(seed=update))
        moved = {name for name, value in values.items() if not value.equal(before[name])}
        assert any(name.startswith("qvalue") for name in moved)
        late = {n for n in moved if n.startswith(("actor", "target"))}
        assert bool(late) == (update % 2 == 0)
        assert ("loss_actor" in log) == (update % 2 == 0)


def test_training_lowers_the_error_of_the_critics_on_a_fixed_batch():
    learner = make_learner(tau=0.001)
    first = learner.update(make_batch())["loss_value"]
    for _ in range(200):
        last = learner.update(make_batch())["loss_value"]
    assert last < 0.2 * first


def test_a_restored_learner_goes_on_to_the_same_numbers():
    learner, restored = make_learner(), make_learner()
    for seed in range(3):
        learner.update(make_batch(seed=seed))
    restored.load_state_dict(deepcopy(learner.state_dict()))
    found = []
    for each in (learner, restored):
        torch.manual_seed(7)
        found.append([each.update(make_batch(seed=seed))["loss_value"] for seed in range(3, 6)])
    assert all(a.equal(b) for a, b in zip(*found, strict=True))
