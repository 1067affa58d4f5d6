"""Replay whose priority is fused from several signals, as TorchRL parts."""

__version__ = "0.1.0"
