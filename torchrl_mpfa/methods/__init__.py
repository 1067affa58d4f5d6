"""Methods that the paper compares with, and newer ones: one file each that needs code of its own.

What is a choice of other parts has no file: it is a few lines of configuration.
"""

from torchrl_mpfa.methods.assembly import Replay, loss_options, make_replay
from torchrl_mpfa.methods.catalogue import ALIASES, METHODS, Method
from torchrl_mpfa.methods.cer import CombinedSampler
from torchrl_mpfa.methods.curiosity import Curiosity, intrinsic_reward
from torchrl_mpfa.methods.geometric import GeometricSampler, geometric_age
from torchrl_mpfa.methods.halves import uniform_halves
from torchrl_mpfa.methods.hvper import (
    RELATIVE_ERROR,
    RELATIVE_VALUE,
    ReplayPenalty,
    relative_error,
    relative_value,
    value_schedule,
)
from torchrl_mpfa.methods.klper import LowestDivergence, gaussian_divergence
from torchrl_mpfa.methods.la3p import LA3PSampler, split_draws
from torchrl_mpfa.methods.lap import PriorityFloor
from torchrl_mpfa.methods.mw import CappedSampler
from torchrl_mpfa.methods.rank import RankSampler, rank_share
from torchrl_mpfa.methods.reaper import ENDED, EPISODE, ReaPERSampler, reliability
from torchrl_mpfa.methods.ref_er import RememberForget, RememberingSampler, importance_ratio
from torchrl_mpfa.methods.remote import (
    MethodReplayBuffer,
    RaySignalReplayBuffer,
    can_be_remote,
    make_ray_replay,
)

__all__ = [
    "ALIASES",
    "ENDED",
    "EPISODE",
    "METHODS",
    "RELATIVE_ERROR",
    "RELATIVE_VALUE",
    "CappedSampler",
    "CombinedSampler",
    "Curiosity",
    "GeometricSampler",
    "LA3PSampler",
    "LowestDivergence",
    "Method",
    "MethodReplayBuffer",
    "PriorityFloor",
    "RankSampler",
    "RaySignalReplayBuffer",
    "ReaPERSampler",
    "RememberForget",
    "RememberingSampler",
    "Replay",
    "ReplayPenalty",
    "can_be_remote",
    "gaussian_divergence",
    "geometric_age",
    "importance_ratio",
    "intrinsic_reward",
    "loss_options",
    "make_ray_replay",
    "make_replay",
    "rank_share",
    "relative_error",
    "relative_value",
    "reliability",
    "split_draws",
    "uniform_halves",
    "value_schedule",
]
