"""Learners: networks, loss, optimizers and target networks behind one ``update``."""

from torchrl_mpfa.learners.base import ActorCriticLearner, Learner
from torchrl_mpfa.learners.ddpg import DDPGLearner
from torchrl_mpfa.learners.dqn import DQNLearner, TabularQLearner
from torchrl_mpfa.learners.sac import SACLearner
from torchrl_mpfa.learners.targets import MultiTensorSoftUpdate
from torchrl_mpfa.learners.td3 import TD3Learner

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
