"""Checks of what environments are given, before anything changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.checks import check_seed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.env.episodes import EpisodeSource
    from mpfa_envs.worlds.world import Task, World

_KEYS: Final = ("reset_mask", "tasks", "worlds")


def read_view(
    metadata: Mapping[str, Any], render_mode: str | None, shown_for: float
) -> dict[str, Any]:
    """Check the render mode; the metadata for pictures that stand for so long in real time [s]."""
    modes = metadata["render_modes"]
    if render_mode not in (None, *modes):
        names = " or ".join(map(repr, modes))
        raise ValueError(f"render_mode must be None or {names}, got {render_mode!r}")
    return {**metadata, "render_fps": max(round(1 / shown_for), 1)}


def read_mask(name: str, mask: NDArray[np.bool_] | None, robots: int) -> NDArray[np.bool_]:
    """A copy of a mask of robots, ``[N]``; None means all."""
    if mask is None:
        return np.ones(robots, dtype=np.bool_)
    if not isinstance(mask, np.ndarray) or mask.shape != (robots,) or mask.dtype != np.bool_:
        raise ValueError(f"{name} must be a NumPy array of {robots} bool, got {mask!r}")
    return mask.copy()


def read_reset_mask(options: Mapping[str, Any] | None, robots: int) -> NDArray[np.bool_]:
    """Robots that start, ``[N]``: all, or those of ``"reset_mask"``."""
    if not isinstance(options, Mapping | None):
        raise ValueError(f"options must be a dictionary or None, got {options!r}")
    for key in options or ():
        if key not in _KEYS:
            raise ValueError(f"options must have keys among {list(_KEYS)}, got {key!r}")
    mask = read_mask("reset_mask", (options or {}).get("reset_mask"), robots)
    if not mask.any():
        raise ValueError("reset_mask must name at least one robot, got none")
    return mask


def read_tasks(
    options: Mapping[str, Any] | None,
    robots: int,
    source: EpisodeSource,
) -> list[tuple[World, Task | None] | None]:
    """World and task given for each robot: None where neither is, no task where only a world is."""
    worlds, tasks = (_read_list(options, key, robots) for key in ("worlds", "tasks"))
    found: list[tuple[World, Task | None] | None] = []
    for robot, (choice, task) in enumerate(zip(worlds, tasks, strict=True)):
        if choice is None and task is None:
            found.append(None)
            continue
        try:
            world = source.world(robot, choice)
            found.append((world, None if task is None else source.check_task(world, *task)))
        except ValueError as error:
            raise ValueError(f"robot {robot}: {error}") from error
    return found


def _read_list(options: Mapping[str, Any] | None, key: str, robots: int) -> Sequence[Any]:
    """One entry for each robot."""
    values = (options or {}).get(key)
    if values is None:
        return [None] * robots
    if isinstance(values, (str, bytes)) or not isinstance(values, Sequence):
        raise ValueError(f"{key} must be a sequence with an entry for each robot, got {values!r}")
    if len(values) != robots:
        raise ValueError(f"{key} must have {robots} entries, got {len(values)}")
    return values


def read_seed(
    seed: int | Sequence[int | None] | None, robots: int
) -> dict[int, np.random.Generator]:
    """New generators by robot; there are none where the present ones are kept."""
    if seed is None:
        return {}
    if isinstance(seed, Sequence) and not isinstance(seed, (str, bytes)):
        if len(seed) != robots:
            raise ValueError(f"seed must have {robots} entries, got {len(seed)}")
        checked = [None if one is None else check_seed(one) for one in seed]
        given = {robot: one for robot, one in enumerate(checked) if one is not None}
        return {robot: np.random.default_rng(one) for robot, one in given.items()}
    return dict(enumerate(spawn_generators(np.random.SeedSequence(check_seed(seed)), robots)))


def spawn_generators(sequence: np.random.SeedSequence, robots: int) -> list[np.random.Generator]:
    """A generator for each robot that does not depend on the number of robots."""
    return [np.random.default_rng(child) for child in sequence.spawn(robots)]
