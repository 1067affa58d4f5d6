"""Actors and critics."""

from torchrl_mpfa.networks.bounds import ActionScale, action_bounds
from torchrl_mpfa.networks.deterministic import (
    Actor,
    Critic,
    DirectModule,
    make_actor,
    make_critic,
    make_value_network,
)
from torchrl_mpfa.networks.stochastic import (
    StochasticActor,
    StochasticNetwork,
    make_stochastic_actor,
    sample_tanh_normal,
)

__all__ = [
    "ActionScale",
    "Actor",
    "Critic",
    "DirectModule",
    "StochasticActor",
    "StochasticNetwork",
    "action_bounds",
    "make_actor",
    "make_critic",
    "make_stochastic_actor",
    "make_value_network",
    "sample_tanh_normal",
]
