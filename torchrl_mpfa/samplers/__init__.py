"""Samplers: from segment trees, by fused signals, in slices, and with the paper's choices."""

from torchrl_mpfa.samplers import uniform as uniform
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.samplers.mpfa import MPFASampler
from torchrl_mpfa.samplers.prioritized import TreeSampler
from torchrl_mpfa.samplers.slices import SignalSliceSampler
from torchrl_mpfa.samplers.table import SignalTable

__all__ = ["MPFASampler", "SignalSampler", "SignalSliceSampler", "SignalTable", "TreeSampler"]
