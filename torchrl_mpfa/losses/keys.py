"""What losses share by name: signals, keys, and the ways in which they use importance weights."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict.utils import NestedKey

from torchrl_mpfa.signals import ACTION_GRADIENT, INFORMATION_GAIN, SIGNALS_KEY, TD_ERROR

VALUE = "value"
"""Name of the signal that is Q itself, which may be negative."""
DEFAULT_SIGNALS = (TD_ERROR.name, ACTION_GRADIENT.name)
KNOWN_SIGNALS = (*DEFAULT_SIGNALS, VALUE, INFORMATION_GAIN.name)
"""What a loss can be asked to write."""


@dataclass
class SignalKeys:
    """Keys that a loss of this package reads or writes beside those of TorchRL's loss."""

    action: NestedKey = "action"
    preactivation: NestedKey = "preactivation"
    td_error_signal: NestedKey = TD_ERROR.key
    action_gradient_signal: NestedKey = ACTION_GRADIENT.key
    value_signal: NestedKey = (SIGNALS_KEY, VALUE)
    information_gain_signal: NestedKey = INFORMATION_GAIN.key


def check_importance(importance: str) -> None:
    """Reject a use of importance weights that there is not."""
    if importance not in ("critic", "torchrl", "none"):
        raise ValueError(f"importance must be 'critic', 'torchrl' or 'none', got {importance!r}")
