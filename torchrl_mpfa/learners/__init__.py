"""Learners: networks, loss, optimizers and target networks behind one ``update``."""

from typing import Any

from torchrl_mpfa.learners.base import ActorCriticLearner, Learner
from torchrl_mpfa.learners.ddpg import DDPGLearner
from torchrl_mpfa.learners.dqn import DQNLearner, TabularQLearner
from torchrl_mpfa.learners.sac import SACLearner
from torchrl_mpfa.learners.targets import MultiTensorSoftUpdate
from torchrl_mpfa.learners.td3 import TD3Learner
from torchrl_mpfa.renamed import OF_LEARNERS, find

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


def __getattr__(name: str) -> Any:
    """Old names, which warn."""
    return find(__name__, name, OF_LEARNERS)
