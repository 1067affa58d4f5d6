"""The results of a time step for many robots: distances, ends of episodes, and Eq. (25)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.paths.grid_loops import interpolate
from mpfa_envs.tasks import reward
from mpfa_envs.worlds.arrays import clearance_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.paths.distance import FieldArrays
    from mpfa_envs.worlds.arrays import BatchArrays

# Compiled here: the package's first import knows the function without Numba.
reward_terms = njit(reward.reward_terms)

# Rows of the tables of a batch: the keys of the info dictionary in their order.
SUCCESS: Final = 0
COLLISION: Final = 1
TIMEOUT: Final = 2
REWARD: Final = 0
"""First of the four terms of the reward."""
SIM_TIME: Final = 4
PATH_LENGTH: Final = 5
SHORTEST_PATH: Final = 6
MIN_CLEARANCE: Final = 7
DISTANCE: Final = 8
POSE: Final = 9
"""First of x, y and the heading."""
ENCOUNTERS: Final = 12
"""First of the walkers' measures: distance, time in personal space, time to collision."""


class EpisodeArrays(NamedTuple):
    """The episodes of a batch of robots, changed in place."""

    motions: NDArray[np.float64]
    """Poses and speeds (x, y, heading, forward, turning), ``[N, 5]``."""
    goals: NDArray[np.float64]
    """Positions (x, y) [m], ``[N, 2]``."""
    numbers: NDArray[np.float64]
    """The numbers of the info dictionary, ``[15, N]``."""
    flags: NDArray[np.bool_]
    """Its flags, ``[3, N]``."""
    steps: NDArray[np.int64]
    """Time steps so far, ``[N]``."""
    clearances: NDArray[np.float64]
    """Distance of the robots' rims from the nearest obstacle or wall [m], ``[N]``."""
    remaining: NDArray[np.float64]
    """The rest of the path to the goal, as the progress is measured, now and before the last time
    step [m], ``[2, N]``."""


@njit
def judge(
    episodes: EpisodeArrays,
    worlds: BatchArrays,
    running: NDArray[np.bool_],  # have moved, [N]
    speeds: NDArray[np.float64],  # of the wheels that an action asks for [m/s], [N, 2]
    trails: NDArray[np.float64],  # positions [m] and these speeds so far, [N, steps, 4]
    rules: tuple[float, float, float, float],  # robot, collision, goal radius [m], time_step [s]
    max_steps: int,
) -> None:
    """Update lengths, distances and flags of the robots that have moved."""
    radius, collision_distance, goal_radius, time_step = rules
    motions, numbers, flags = episodes.motions, episodes.numbers, episodes.flags
    for robot in range(motions.shape[0]):
        if not running[robot]:
            continue
        x, y = motions[robot, 0], motions[robot, 1]
        episodes.steps[robot] += 1
        steps = episodes.steps[robot]
        trails[robot, steps, 0], trails[robot, steps, 1] = x, y
        trails[robot, steps, 2], trails[robot, steps, 3] = speeds[robot, 0], speeds[robot, 1]
        moved = math.hypot(x - numbers[POSE, robot], y - numbers[POSE + 1, robot])
        distance = math.hypot(episodes.goals[robot, 0] - x, episodes.goals[robot, 1] - y)
        to_obstacle = clearance_at(worlds, robot, x, y)
        success = distance <= goal_radius
        collision = not success and to_obstacle <= collision_distance
        flags[SUCCESS, robot], flags[COLLISION, robot] = success, collision
        flags[TIMEOUT, robot] = not (success or collision) and steps >= max_steps
        clearance = to_obstacle - radius
        episodes.clearances[robot] = clearance
        episodes.remaining[1, robot], episodes.remaining[0, robot] = (
            episodes.remaining[0, robot],
            distance,
        )
        numbers[SIM_TIME, robot] = steps * time_step
        numbers[PATH_LENGTH, robot] += moved
        numbers[MIN_CLEARANCE, robot] = min(numbers[MIN_CLEARANCE, robot], clearance)
        numbers[DISTANCE, robot] = distance
        numbers[POSE, robot], numbers[POSE + 1, robot] = x, y
        numbers[POSE + 2, robot] = motions[robot, 2]


@njit
def settle(
    episodes: EpisodeArrays,
    running: NDArray[np.bool_],  # have moved, [N]
    payments: tuple[float, float, float, float],  # goal, collision, meter, cost of a step
) -> bool:
    """Add the terms of Eq. (25), stop ended episodes, and return True if a robot still runs."""
    numbers, flags = episodes.numbers, episodes.flags
    left = False
    for robot in range(running.shape[0]):
        if not running[robot]:
            continue
        success, collision = flags[SUCCESS, robot], flags[COLLISION, robot]
        approach = episodes.remaining[1, robot] - episodes.remaining[0, robot]
        terms = reward_terms(success, collision, approach, payments)
        for k in range(len(terms)):
            numbers[REWARD + k, robot] += terms[k]
        ended = success or collision or flags[TIMEOUT, robot]
        running[robot] = not ended
        left |= not ended
    return left


def outcomes(
    episodes: EpisodeArrays, moving: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Rewards, terminations and truncations, ``[N]``; zero and false for robots at rest."""
    at_goal, hit, approach, cost = episodes.numbers[REWARD : REWARD + 4]
    rewards = np.where(moving, at_goal + hit + approach + cost, 0.0)
    success, collision, timeout = episodes.flags
    return rewards, moving & (success | collision), moving & timeout


@njit
def measure_remaining(
    episodes: EpisodeArrays, running: NDArray[np.bool_], fields: FieldArrays
) -> None:
    """Measure the rest of the shortest path to the goal for the robots that have moved."""
    for robot in range(running.shape[0]):
        if running[robot]:
            episodes.remaining[0, robot] = interpolate(
                fields.values,
                robot,
                fields.shapes[robot, 0],
                fields.shapes[robot, 1],
                fields.origins[robot, 0],
                fields.origins[robot, 1],
                fields.resolutions[robot],
                episodes.motions[robot, 0],
                episodes.motions[robot, 1],
            )
