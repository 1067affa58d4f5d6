"""The state of an environment: where its episodes began, and how they were driven since."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mpfa_envs.checks import check_count
from mpfa_envs.env.episodes import EpisodeSource, EpisodeState, generator_at
from mpfa_envs.generators.generate import world_of_name

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.env.config import TaskConfig


def robot_to_plain(begin: EpisodeState, speeds: NDArray[np.float64]) -> dict[str, Any]:
    """Turn the beginning of an episode, and the wheel speeds since, into plain values."""
    if begin.given:
        raise ValueError(
            "an episode cannot be saved whose world or task the options of a reset gave: save "
            "after the next reset() without them"
        )
    return {
        "generator": copy.deepcopy(begin.generator),
        "left": begin.left,
        "kept": begin.kept.name if begin.kept and begin.left else None,
        "speeds": speeds,
    }


def read_state(
    state: Any, arguments: Mapping[str, Any], config: TaskConfig, source: EpisodeSource
) -> tuple[list[EpisodeState], list[NDArray[np.float64]], list[np.random.Generator | None]]:
    """Check a state: beginnings, wheel speeds since, and generators of the next episodes."""
    try:
        if "batch" in state:
            raise ValueError(
                "it is of an earlier version, and its episodes under way cannot be continued: "
                "begin new ones with reset()"
            )
        for name, value in arguments.items():
            if (found := state["arguments"].get(name)) != value:
                raise ValueError(
                    f"it must be of an environment with {name} = {value!r}, got one with {found!r}"
                )
        robots, count = state["robots"], arguments["num_envs"]
        if len(robots) not in (0, count) or len(state["seeded"]) != count:
            raise ValueError(f"robots and seeded must have {count} entries, got {len(robots)}")
        if np.shape(np.array(state["positions"], dtype=np.float64)) != (count, 2):
            raise ValueError(f"positions must have shape ({count}, 2)")
        check_count("rejected", state["rejected"], least=0, most=math.inf)
        driven = [_read_speeds(robot["speeds"], config) for robot in robots]
        seeded = [None if seed is None else generator_at(seed) for seed in state["seeded"]]
        return _read_states(robots, source), driven, seeded
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        reason = error if isinstance(error, ValueError) else f"no state_dict() gave it, {error!r}"
        raise ValueError(f"state cannot be loaded: {reason}") from error


def _read_states(robots: list[dict[str, Any]], source: EpisodeSource) -> list[EpisodeState]:
    """Check where the episodes of a state began."""
    begins = []
    for robot in robots:
        left = check_count("left", robot["left"], least=0)
        kept = world_of_name(str(robot["kept"])) if left else None
        if left and kept is None:
            raise ValueError(f"kept must name a generator's world, got {robot['kept']!r}")
        if kept is not None:
            source.check_world(kept)
        begin = generator_at(robot["generator"]).bit_generator.state
        begins.append(EpisodeState(begin, left, kept, given=False))
    return begins


def _read_speeds(values: Any, config: TaskConfig) -> NDArray[np.float64]:
    """Check the wheel speeds of a robot's actions [m/s], ``[A, 2]``."""
    speeds = np.array(values, dtype=np.float64).reshape(len(values), 2)
    low, high = min(config.robot.wheel_limits.slow, 0.0), config.robot.wheel_limits.fast
    most = math.ceil(config.max_steps / config.action_repeat)
    # NaN is not above anything.
    inside = (speeds > low - 1e-9) & (speeds < high + 1e-9)
    if not inside.all() or len(speeds) > most:
        raise ValueError(
            f"speeds must be at most {most} pairs from {low} to {high} m/s, got {len(speeds)}, "
            f"others of which are {speeds[~inside].tolist()}"
        )
    return speeds
