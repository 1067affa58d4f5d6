"""Settings of a run whose robots drive on a Ray cluster."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class RaySettings:
    """Where the robots drive; ``docs/scaling.md`` has what it needs and what it brings."""

    workers: int = 0
    """Processes that drive the robots, each an equal part of them; 0: the run drives them."""
    address: str | None = None
    """Of a cluster's head; null: that of ``RAY_ADDRESS``, one that was started on this machine, or
    else the cores of this machine."""
    steps: int = 16
    """Actions of each robot of a worker before it writes them and gets new weights."""
    sync: bool = False
    """Whether the workers wait for each other and for the updates. If not, they drive on while the
    learner learns, and no two runs are alike."""
