"""One episode to drive: a start and a goal."""

from __future__ import annotations

from typing import Any, NamedTuple

START_SLACK = 0.15
"""Clearance of a start beyond that of a collision [m]."""


class Task(NamedTuple):
    """One episode to drive; ``task._asdict()`` is what ``reset(options=...)`` takes."""

    start: tuple[float, float, float]
    """Pose (x, y, heading) [m, m, rad]."""
    goal: tuple[float, float]
    """Position (x, y) [m]."""


def read_task(values: Any) -> Task:
    """Make a task of a start and a goal."""
    try:
        (x, y, heading), (goal_x, goal_y) = values
        return Task((float(x), float(y), float(heading)), (float(goal_x), float(goal_y)))
    except (TypeError, ValueError) as error:
        raise ValueError(f"task must be a start and a goal, got {values!r}") from error
