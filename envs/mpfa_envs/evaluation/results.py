"""Results of evaluation episodes, and rates and means of them with their intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

ENCOUNTERS = ("walker_distance", "intrusion_time", "time_to_collision")
"""Measures of encounters with walkers in the info of an environment and in a result."""
_JACKAL_SPEED = 2.0
"""Top speed of the robot of the BARN benchmark [m/s]."""
_LEVEL = 0.95
_RESAMPLES = 2000


@dataclass(frozen=True)
class EpisodeResult:
    """One evaluation episode."""

    episode: int
    """Number of the task in its world."""
    success: bool
    collision: bool
    timeout: bool
    """True if the time was up, wherever the robot was."""
    time_s: float
    """Simulated time [s]."""
    path_length: float
    """Distance driven [m]."""
    shortest_path: float
    """Shortest path of the task [m]."""
    min_clearance: float
    """Least distance between the robot's rim and an obstacle, wall or walker [m]."""
    spl: float
    """Success weighted by path length, see :func:`spl`."""
    sct: float
    """Success weighted by completion time, see :func:`sct`."""
    plan_s: float = field(default=0.0, compare=False)
    """CPU time of planning before the first action [s]. Results that differ in times of the
    machine alone are equal."""
    decision_s: float = field(default=0.0, compare=False)
    """Mean CPU time of an action [s]; its share where several robots act together."""
    world: str = ""
    """Name of the world."""
    walker_distance: float | None = None
    """Least distance between the robot's rim and a walker's [m]; None without walkers."""
    intrusion_time: float | None = None
    """Time in the personal space of a walker, within 0.5 m of its rim [s]."""
    time_to_collision: float | None = None
    """Least time after which robot and walker would have touched had both kept their velocities, at
    most 10 s [s]."""
    barn_score: float | None = None
    """Score of the BARN Challenge, see :func:`barn_score`; None where its task is not driven."""
    standstill: bool = False
    """True if the time was up and the robot stood still, turning or not, in its last ten
    seconds."""

    @property
    def outcome(self) -> Literal["success", "collision", "timeout", "standstill"]:
        """The name of the episode's end."""
        if self.success:
            return "success"
        if self.collision:
            return "collision"
        return "standstill" if self.standstill else "timeout"


def spl(success: bool, *, path_length: float, shortest_path: float) -> float:
    """Success weighted by path length, of one episode (https://arxiv.org/abs/1807.06757).

    Args:
        success: True if the goal was reached.
        path_length: Distance driven [m].
        shortest_path: Shortest path of the task [m].

    Returns:
        0 for a failure, 1 for a success on the shortest path.

    Examples:
        >>> spl(True, path_length=4.0, shortest_path=3.0)
        0.75
    """
    return success * shortest_path / max(path_length, shortest_path)


def sct(success: bool, *, time_s: float, shortest_path: float, speed: float) -> float:
    """Success weighted by completion time, of one episode (https://arxiv.org/abs/2103.08022).

    The least time counts no turns and no acceleration: no robot reaches 1.

    Args:
        success: True if the goal was reached.
        time_s: Simulated time [s].
        shortest_path: Shortest path of the task [m].
        speed: Greatest speed of the robot [m/s].

    Returns:
        0 for a failure, 1 for a success in the time of the shortest path at the greatest speed.

    Examples:
        >>> sct(True, time_s=10.0, shortest_path=3.0, speed=0.5)
        0.6
    """
    least = shortest_path / speed
    return success * least / max(time_s, least)


def barn_score(success: bool, *, time_s: float, reference_path: float) -> float:
    """Score of the BARN Challenge of 2022, of one episode.

    ``s = 1[success] OT / clip(AT, 4 OT, 8 OT)``: AT is the actual time, and OT the optimal time,
    that of the benchmark's robot, a Jackal, on the reference path at its top speed of 2 m/s (Xiao
    et al. 2022, https://doi.org/10.1109/MRA.2022.3213466). Later challenges have 2 OT in place of
    4 OT.

    Args:
        success: True if the goal was reached.
        time_s: Simulated time [s].
        reference_path: Length of the benchmark's reference path [m], which is positive.

    Returns:
        0 for a failure, else 1/8 to 1/4; 1/4 for a mean speed along the reference path of 0.5 m/s
        or more.

    Examples:
        >>> [barn_score(True, time_s=time, reference_path=10.0) for time in (19.0, 25.0, 60.0)]
        [0.25, 0.2, 0.125]
    """
    optimal = reference_path / _JACKAL_SPEED
    return success * optimal / min(max(time_s, 4 * optimal), 8 * optimal)


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


def summarize(results: Sequence[EpisodeResult], *, seed: int = 0) -> dict[str, Interval]:
    """Rates and means with 95 % intervals; time and path count successes only.

    Rates have Wilson's interval, which stays right near 0 and 1, means that of the percentile
    bootstrap; NaN for fewer than two values. Episodes count as
    independent: for worlds other than these, intervals are too narrow where a world has several.

    Args:
        results: The episodes.
        seed: Seed of the bootstrap.

    Returns:
        Estimates by name; success, collision and timeout sum to one, and timeouts of robots that
        stood still are standstills, too. Means of encounters with
        walkers are among them if there were any, over the episodes with walkers, and so is BARN's
        score, over the episodes of its task.

    Raises:
        ValueError: If there are no results.
    """
    if not results:
        raise ValueError("results must hold at least one episode")
    rng = np.random.default_rng(seed)
    reached = [result for result in results if result.success]
    summary = {
        "success": wilson([result.success for result in results]),
        "collision": wilson([result.collision for result in results]),
        "timeout": wilson([result.timeout for result in results]),
        "standstill": wilson([result.standstill for result in results]),
        "spl": bootstrap([result.spl for result in results], rng),
        "sct": bootstrap([result.sct for result in results], rng),
        "time_s": bootstrap([result.time_s for result in reached], rng),
        "path_length": bootstrap([result.path_length for result in reached], rng),
        "min_clearance": bootstrap([result.min_clearance for result in results], rng),
        "plan_s": bootstrap([result.plan_s for result in results], rng),
        "decision_s": bootstrap([result.decision_s for result in results], rng),
    }
    for name in (*ENCOUNTERS, "barn_score"):
        values = [getattr(result, name) for result in results]
        if met := [value for value in values if value is not None]:
            summary[name] = bootstrap(met, rng)
    return summary


def wilson(outcomes: Sequence[bool]) -> Interval:
    """A rate with Wilson's 95 % interval; at least one outcome."""
    from scipy.stats import binomtest

    test = binomtest(sum(outcomes), len(outcomes))
    found = test.proportion_ci(_LEVEL, method="wilson")
    return Interval(float(test.statistic), float(found.low), float(found.high))


def bootstrap(values: Sequence[float], rng: np.random.Generator) -> Interval:
    """A mean with its 95 % percentile bootstrap interval; NaN for too few values."""
    from scipy import stats

    if len(values) < 2:
        return Interval(float(values[0]) if values else math.nan, math.nan, math.nan)
    found = stats.bootstrap(
        (np.asarray(values, dtype=np.float64),),
        np.mean,
        n_resamples=_RESAMPLES,
        batch=100,
        confidence_level=_LEVEL,
        method="percentile",
        rng=rng,
    ).confidence_interval
    return Interval(float(np.mean(values)), float(found.low), float(found.high))
