"""Learners: networks, losses, one optimizer and target networks behind one ``update``."""

from typing import Any

from torchrl_mpfa.lazy import find
from torchrl_mpfa.learners.actor_critic import ActorCritic
from torchrl_mpfa.learners.dqn import DQN
from torchrl_mpfa.learners.optimized import Learner

__all__ = ["DQN", "ActorCritic", "Learner"]


def __getattr__(name: str) -> Any:
    """Import a module when it is first used."""
    return find(__name__, name, {})
