"""What a robot is ordered."""

from __future__ import annotations

from typing import NamedTuple


class Command(NamedTuple):
    """Speeds until the next decision."""

    left: float
    """Speed of the left wheel [m/s]."""
    right: float
    """Speed of the right wheel [m/s]."""
    linear: float
    """The same as the body's forward speed [m/s],"""
    angular: float
    """and its turning speed, to the left [rad/s]."""
