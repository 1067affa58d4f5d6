"""Learners: networks, losses, one optimizer and target networks behind one ``update``."""

from torchrl_mpfa.learners.actor_critic import ActorCritic
from torchrl_mpfa.learners.dqn import DQN
from torchrl_mpfa.learners.optimized import Learner

__all__ = ["DQN", "ActorCritic", "Learner"]
