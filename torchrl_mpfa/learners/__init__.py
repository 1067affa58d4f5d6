"""Learners: networks, loss, optimizers and target networks behind one ``update``."""

from torchrl_mpfa.learners.base import ActorCriticLearner, Learner, MultiTensorSoftUpdate
from torchrl_mpfa.learners.dqn import DQNLearner, TabularQLearner

__all__ = [
    "ActorCriticLearner",
    "DQNLearner",
    "Learner",
    "MultiTensorSoftUpdate",
    "TabularQLearner",
]
