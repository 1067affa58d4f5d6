"""Networks, losses and learners of SAC that its tests share."""

from copy import deepcopy

import torch

from tests.mpfa.losses import GAMMA
from torchrl_mpfa import SACLearner, make_critic, make_sac_loss, make_stochastic_actor


def make_networks(seed=0, size=5, **kwargs):
    torch.manual_seed(seed)
    arguments = {"width": 16, "final_init": 0.5, **kwargs}
    return make_stochastic_actor(size, 2, **arguments), make_critic(size, 2, **arguments)


def make_loss(seed=0, **kwargs):
    """A loss whose target critics differ from the current ones, lest a mix-up goes unseen."""
    loss = make_sac_loss(*make_networks(seed), gamma=GAMMA, **kwargs)
    with torch.no_grad():
        for tensor in loss.target_qvalue_network_params.flatten_keys().values():
            tensor.mul_(0.7)
    return loss


def make_learner(seed=0, *, of_loss=None, **kwargs):
    loss = make_sac_loss(*make_networks(seed), gamma=GAMMA, **(of_loss or {}))
    return SACLearner(loss, **{"actor_lr": 1e-3, "critic_lr": 1e-3, **kwargs})


def evaluate(loss, batch, seed=1):
    torch.manual_seed(seed)  # Actions are random.
    return loss(batch)


def critics_of(loss, params):
    """Each of the critics as a function of observation and action."""
    found = []
    for index in range(2):
        critic = deepcopy(loss.qvalue_network)
        params[index].detach().to_module(critic)
        found.append(critic.module)
    return found
