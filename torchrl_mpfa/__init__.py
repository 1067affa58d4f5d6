"""Replay whose priority is fused from several signals, as TorchRL parts."""

from torchrl_mpfa.adjustment import (
    Adjustment,
    BatchFacts,
    Counting,
    PositiveBoost,
    PositiveDecay,
)
from torchrl_mpfa.fusion import EntropyFusion, FixedFusion, Fusion
from torchrl_mpfa.history import ReplayHistory
from torchrl_mpfa.learners import (
    DDPGLearner,
    DQNLearner,
    Learner,
    QLearner,
    SACLearner,
    TD3Learner,
)
from torchrl_mpfa.losses import (
    SignalDDPGLoss,
    SignalDQNLoss,
    SignalLoss,
    SignalSACLoss,
    SignalTD3Loss,
    make_ddpg_loss,
    make_sac_loss,
    make_td3_loss,
)
from torchrl_mpfa.moving_fusion import Annealed, ScaledFusion, ScheduledFusion
from torchrl_mpfa.networks import (
    DirectModule,
    make_actor,
    make_critic,
    make_stochastic_actor,
    make_value_network,
    make_value_table,
)
from torchrl_mpfa.replay import SignalReplayBuffer
from torchrl_mpfa.samplers import MixtureSampler, MPFASampler, SignalSampler, TreeSampler
from torchrl_mpfa.saving import load_safely, save_atomically, write_text_atomically
from torchrl_mpfa.selection import Draw, Selection, one_batch
from torchrl_mpfa.signals import (
    ACTION_GRADIENT,
    MPFA_SIGNALS,
    REWARD,
    TD_ERROR,
    Signal,
)
from torchrl_mpfa.storages import SignalMemmapStorage, SignalTable, SignalTensorStorage
from torchrl_mpfa.updates import run_updates

__version__ = "0.2.0"

__all__ = [
    "ACTION_GRADIENT",
    "MPFA_SIGNALS",
    "REWARD",
    "TD_ERROR",
    "Adjustment",
    "Annealed",
    "BatchFacts",
    "Counting",
    "DDPGLearner",
    "DQNLearner",
    "DirectModule",
    "Draw",
    "EntropyFusion",
    "FixedFusion",
    "Fusion",
    "Learner",
    "MPFASampler",
    "MixtureSampler",
    "PositiveBoost",
    "PositiveDecay",
    "QLearner",
    "ReplayHistory",
    "SACLearner",
    "ScaledFusion",
    "ScheduledFusion",
    "Selection",
    "Signal",
    "SignalDDPGLoss",
    "SignalDQNLoss",
    "SignalLoss",
    "SignalMemmapStorage",
    "SignalReplayBuffer",
    "SignalSACLoss",
    "SignalSampler",
    "SignalTD3Loss",
    "SignalTable",
    "SignalTensorStorage",
    "TD3Learner",
    "TreeSampler",
    "load_safely",
    "make_actor",
    "make_critic",
    "make_ddpg_loss",
    "make_sac_loss",
    "make_stochastic_actor",
    "make_td3_loss",
    "make_value_network",
    "make_value_table",
    "one_batch",
    "run_updates",
    "save_atomically",
    "write_text_atomically",
]
