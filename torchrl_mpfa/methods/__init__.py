"""Methods that the paper compares with, and newer ones: one file each that needs code of its own.

What is a choice of other parts has no file: it is a few lines of configuration.
"""

from torchrl_mpfa.methods.klper import LowestDivergence, gaussian_divergence

__all__ = ["LowestDivergence", "gaussian_divergence"]
