"""One episode to drive: a start and a goal."""

from __future__ import annotations

from typing import NamedTuple

START_SLACK = 0.15
"""Clearance of a start beyond that of a collision [m]."""


class Task(NamedTuple):
    """One episode to drive; ``task._asdict()`` is what ``reset(options=...)`` takes."""

    start: tuple[float, float, float]
    """Pose (x, y, heading) [m, m, rad]."""
    goal: tuple[float, float]
    """Position (x, y) [m]."""
