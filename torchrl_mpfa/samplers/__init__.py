"""Samplers: from segment trees, by fused signals, in slices, and with the paper's choices."""

from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.samplers.mpfa import MPFASampler
from torchrl_mpfa.samplers.prioritized import TreeSampler
from torchrl_mpfa.samplers.slices import SignalSliceSampler

__all__ = ["MPFASampler", "SignalSampler", "SignalSliceSampler", "TreeSampler"]
