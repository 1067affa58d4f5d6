"""TorchRL's losses, which write the signals of each transition as they go."""

from torchrl_mpfa.losses.base import SignalLoss
from torchrl_mpfa.losses.ddpg import SignalDDPGLoss, make_ddpg_loss
from torchrl_mpfa.losses.dqn import SignalDQNLoss
from torchrl_mpfa.losses.functional import bootstrap_target
from torchrl_mpfa.losses.sac import SignalSACLoss, make_sac_loss
from torchrl_mpfa.losses.td3 import SignalTD3Loss, make_td3_loss
from torchrl_mpfa.losses.torchrl import write_signals

__all__ = [
    "SignalDDPGLoss",
    "SignalDQNLoss",
    "SignalLoss",
    "SignalSACLoss",
    "SignalTD3Loss",
    "bootstrap_target",
    "make_ddpg_loss",
    "make_sac_loss",
    "make_td3_loss",
    "write_signals",
]
