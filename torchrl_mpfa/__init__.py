"""Replay whose priority is fused from several signals, as TorchRL parts."""

from typing import Any

from torchrl_mpfa.adjustment import Adjustment, PositiveBoost, PositiveDecay
from torchrl_mpfa.fusion import EntropyFusion, FixedFusion, Fusion
from torchrl_mpfa.history import ReplayHistory
from torchrl_mpfa.learners import (
    DDPGLearner,
    DQNLearner,
    Learner,
    SACLearner,
    TabularQLearner,
    TD3Learner,
)
from torchrl_mpfa.losses import (
    SignalDDPGLoss,
    SignalDQNLoss,
    SignalSACLoss,
    SignalTD3Loss,
    make_ddpg_loss,
    make_sac_loss,
    make_td3_loss,
)
from torchrl_mpfa.moving_fusion import ScaledFusion, ScheduledFusion
from torchrl_mpfa.networks import make_actor, make_critic, make_stochastic_actor, make_value_network
from torchrl_mpfa.renamed import TOP, find
from torchrl_mpfa.replay import SignalReplayBuffer
from torchrl_mpfa.samplers import MixtureSampler, MPFASampler, SignalSampler
from torchrl_mpfa.signals import ACTION_GRADIENT, MPFA_SIGNALS, REWARD, TD_ERROR, Signal
from torchrl_mpfa.storages import SignalMemmapStorage, SignalTensorStorage
from torchrl_mpfa.updates import run_updates

__version__ = "0.2.0"

__all__ = [
    "ACTION_GRADIENT",
    "MPFA_SIGNALS",
    "REWARD",
    "TD_ERROR",
    "Adjustment",
    "DDPGLearner",
    "DQNLearner",
    "EntropyFusion",
    "FixedFusion",
    "Fusion",
    "Learner",
    "MPFASampler",
    "MixtureSampler",
    "PositiveBoost",
    "PositiveDecay",
    "ReplayHistory",
    "SACLearner",
    "ScaledFusion",
    "ScheduledFusion",
    "Signal",
    "SignalDDPGLoss",
    "SignalDQNLoss",
    "SignalMemmapStorage",
    "SignalReplayBuffer",
    "SignalSACLoss",
    "SignalSampler",
    "SignalTD3Loss",
    "SignalTensorStorage",
    "TD3Learner",
    "TabularQLearner",
    "make_actor",
    "make_critic",
    "make_ddpg_loss",
    "make_sac_loss",
    "make_stochastic_actor",
    "make_td3_loss",
    "make_value_network",
    "run_updates",
]


def __getattr__(name: str) -> Any:
    """Old names, which warn."""
    return find(__name__, name, TOP)
