"""What the reset of a vector environment asks for, checked before anything changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.checks import check_seed
from mpfa_envs.generators.resolve import resolve_world

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.worlds.task import Task
    from mpfa_envs.worlds.world import World

_KEYS: Final = ("reset_mask", "tasks", "worlds")


def read_mask(name: str, mask: NDArray[np.bool_] | None, robots: int) -> NDArray[np.bool_]:
    """Read which robots are meant.

    Args:
        name: What messages call it.
        mask: ``[N]``; None: all.
        robots: Number of robots.

    Returns:
        A mask of its own.

    Raises:
        ValueError: If it is none.
    """
    if mask is None:
        return np.ones(robots, dtype=np.bool_)
    if not isinstance(mask, np.ndarray) or mask.shape != (robots,) or mask.dtype != np.bool_:
        raise ValueError(f"{name} must be a NumPy array of {robots} bool, got {mask!r}")
    return mask.copy()


def read_reset_mask(options: Mapping[str, Any] | None, robots: int) -> NDArray[np.bool_]:
    """Read which robots start.

    Args:
        options: The options of a reset.
        robots: Number of robots.

    Returns:
        All, or those of ``"reset_mask"``, ``[N]``.

    Raises:
        ValueError: If there is a key that no option has, or the mask is none or empty.
    """
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
    world_of: Callable[[int], World | None],
    check: Callable[[World, Task | None], Task | None],
) -> list[tuple[World, Task | None] | None]:
    """Read the worlds and the tasks that the options fix.

    Args:
        options: The options of a reset.
        robots: Number of robots.
        world_of: Gives the world that a robot drives in anyway, or None where that changes.
        check: Refuses a world or a task that cannot be driven.

    Returns:
        World and task for each robot: no task where only the world is fixed, None where nothing is.

    Raises:
        ValueError: If there are not as many as robots, or a task cannot be driven.
    """
    worlds, tasks = (_read_list(options, key, robots) for key in ("worlds", "tasks"))
    found: list[tuple[World, Task | None] | None] = []
    for robot, (choice, task) in enumerate(zip(worlds, tasks, strict=True)):
        if choice is None and task is None:
            found.append(None)
            continue
        try:
            world = world_of(robot) if choice is None else resolve_world(choice)
            if world is None:
                raise ValueError(
                    f"a task must come with a world where these are a generator's, got {task}"
                )
            found.append((world, check(world, task)))
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
) -> Sequence[np.random.Generator | None]:
    """Make a source of randomness for each robot.

    Args:
        seed: One for all, from which each robot's is made with its number; one for each robot; or
            None.
        robots: Number of robots.

    Returns:
        The sources; None where the old one goes on.

    Raises:
        ValueError: If a seed is negative, or there are not as many as robots.
    """
    if seed is None:
        return [None] * robots
    if isinstance(seed, Sequence) and not isinstance(seed, (str, bytes)):
        if len(seed) != robots:
            raise ValueError(f"seed must have {robots} entries, got {len(seed)}")
        checked = [None if one is None else check_seed(one) for one in seed]
        return [None if one is None else np.random.default_rng(one) for one in checked]
    return spawn_generators(np.random.SeedSequence(check_seed(seed)), robots)


def spawn_generators(sequence: np.random.SeedSequence, robots: int) -> list[np.random.Generator]:
    """Make a source of randomness for each robot that does not depend on how many there are."""
    return [np.random.default_rng(child) for child in sequence.spawn(robots)]
