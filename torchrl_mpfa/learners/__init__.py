"""Learners: networks, loss, optimizers and target networks behind one ``update``."""

from torchrl_mpfa.learners.base import (
    ActorCriticLearner,
    DDPGLearner,
    Learner,
    MultiTensorSoftUpdate,
    SACLearner,
    TD3Learner,
)
from torchrl_mpfa.learners.dqn import DQNLearner, TabularQLearner

__all__ = [
    "ActorCriticLearner",
    "DDPGLearner",
    "DQNLearner",
    "Learner",
    "MultiTensorSoftUpdate",
    "SACLearner",
    "TD3Learner",
    "TabularQLearner",
]
