"""Samplers: from segment trees, by fused signals, in slices, and with the paper's choices."""

from torchrl_mpfa.samplers.mpfa import MPFASampler
from torchrl_mpfa.samplers.signal_sampler import SignalSampler
from torchrl_mpfa.samplers.slices import SignalSliceSampler
from torchrl_mpfa.samplers.tree import TreeSampler

__all__ = ["MPFASampler", "SignalSampler", "SignalSliceSampler", "TreeSampler"]
