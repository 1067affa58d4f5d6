"""The paths of episodes from above: of one policy, and of several side by side."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_count
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.scene.canvas import (
    HEIGHT,
    Canvas,
    Entry,
    Key,
    Mark,
    Point,
    Title,
    strip_width,
    tiled,
    titled,
    write_strip,
)
from mpfa_envs.scene.colors import GOAL, GOAL_AREA, GOAL_EDGE, OUTCOMES, ROBOT_FRONT, TRAIL
from mpfa_envs.worlds.world import World

Outcome = Literal["success", "collision", "timeout", "standstill"]
"""The end of an episode."""
Trajectories = Sequence["Sequence[Point] | NDArray[np.float64]"]
"""Positions of each episode, each of shape ``[steps, 2]`` [m]."""

_MARKS: dict[str, Mark] = {
    **{"success": "box", "collision": "cross"},
    **dict.fromkeys(("timeout", "standstill"), "square"),
}


def render_trajectories(
    world: str | os.PathLike[str] | World,
    trajectories: Trajectories,
    goals: Sequence[Point],
    outcomes: Sequence[Outcome],
    *,
    title: str = "",
    walkers: NDArray[np.float64] | None = None,
    goal_radius: float = 0.5,
    most: int = 20,
    size: int = 480,
) -> NDArray[np.uint8]:
    """Render the paths of episodes into one picture of their world.

    A ring marks a start, a dot in a disc a goal and the distance that reaches it, a cross a
    collision and a hollow square where the time was up. The strip below counts how all episodes
    ended. Of many episodes some are shown, failures up to half of them. Of walkers the rounds
    between their waypoints are shown.

    Args:
        world: A name, the path of a YAML file or a world.
        trajectories: Positions of each episode, each of shape ``[steps, 2]`` [m].
        goals: Goal of each episode (x, y) [m].
        outcomes: ``"success"``, ``"collision"``, ``"timeout"`` or ``"standstill"`` for each
            episode.
        title: What to write in the strip.
        walkers: Where walkers are at one moment, as in :func:`render_scene`.
        goal_radius: Distance that reaches a goal [m].
        most: How many paths to show; the strip says if there are more.
        size: Longer side of the picture without the strip [px].

    Returns:
        Picture of shape ``[height, width, 3]``, as wide as the strip's text at least.

    Raises:
        ValueError: If the three lists differ in length, an outcome is unknown, the size is not an
            integer of at least 32, or no path is to be shown.

    Examples:
        >>> from mpfa_envs.render import render_trajectories
        >>> render_trajectories("A", [[(0, 0), (1, 1), (2, 3)]], [(2, 3)], ["success"]).shape
        (508, 480, 3)
    """
    world = resolve_world(world)
    _check(trajectories, goals, outcomes)
    shown = shown_episodes(outcomes, most=most)
    return _panel(
        world,
        trajectories,
        goals,
        outcomes,
        shown,
        title=title,
        walkers=walkers,
        goal_radius=goal_radius,
        size=size,
    )


def render_methods(
    world: str | os.PathLike[str] | World,
    trajectories: Mapping[str, Trajectories],
    goals: Sequence[Point],
    outcomes: Mapping[str, Sequence[Outcome]],
    *,
    goal_radius: float = 0.5,
    most: int = 20,
    columns: int | None = None,
    size: int = 360,
) -> NDArray[np.uint8]:
    """Render the paths of several methods side by side, the same episodes in every panel.

    Args:
        world: A name, the path of a YAML file or a world.
        trajectories: Positions of each episode, by method.
        goals: Goal of each episode (x, y) [m]; all methods drive the same tasks.
        outcomes: How each episode ended, by method.
        goal_radius: Distance that reaches a goal [m].
        most: How many episodes to show, evenly spaced over all of them.
        columns: Panels in a row; None: as many as there are rows.
        size: Longer side of a panel [px].

    Returns:
        Picture of shape ``[height, width, 3]``.

    Raises:
        ValueError: If the methods of the two mappings differ, there is none, or as in
            :func:`render_trajectories`.

    Examples:
        >>> from mpfa_envs.render import render_methods
        >>> paths = {"slow": [[(0, 0), (1, 1)]], "fast": [[(0, 0), (2, 3)]]}
        >>> ends = {"slow": ["timeout"], "fast": ["success"]}
        >>> render_methods("A", paths, [(2, 3)], ends).shape
        (388, 728, 3)
    """
    if not trajectories or set(trajectories) != set(outcomes):
        raise ValueError(
            "trajectories and outcomes must have the same methods, got "
            f"{sorted(trajectories)} and {sorted(outcomes)}"
        )
    world = resolve_world(world)
    for name, paths in trajectories.items():
        _check(paths, goals, outcomes[name])
    shown = _spaced(range(len(goals)), check_count("most", most))
    panels = [
        _panel(
            world,
            paths,
            goals,
            outcomes[name],
            shown,
            title=name,
            walkers=None,
            goal_radius=goal_radius,
            size=size,
        )
        for name, paths in trajectories.items()
    ]
    return tiled(panels, columns=columns)


def shown_episodes(outcomes: Sequence[str], *, most: int) -> list[int]:
    """Choose ``most`` episodes to show, evenly spaced among those of a kind; up to half failures.

    Examples:
        >>> from mpfa_envs.render.trajectories import shown_episodes
        >>> shown_episodes(["success"] * 6 + ["timeout"] * 6, most=4)
        [0, 5, 6, 11]
    """
    check_count("most", most)
    failed = [n for n, outcome in enumerate(outcomes) if outcome != "success"]
    reached = [n for n, outcome in enumerate(outcomes) if outcome == "success"]
    failures = _spaced(failed, max(most // 2, most - len(reached)))
    return sorted([*failures, *_spaced(reached, most - len(failures))])


def _spaced(numbers: Sequence[int], count: int) -> list[int]:
    """Evenly spaced numbers, ``count`` at most, with the first and the last."""
    if len(numbers) <= count:
        return list(numbers)
    places = np.linspace(0, len(numbers) - 1, count).round().astype(int)
    return [numbers[place] for place in places.tolist()]


def _check(trajectories: Trajectories, goals: Sequence[Point], outcomes: Sequence[Outcome]) -> None:
    """Reject lists that do not fit together."""
    if not len(trajectories) == len(goals) == len(outcomes):
        raise ValueError(
            "trajectories, goals and outcomes must have one entry per episode, got "
            f"{len(trajectories)}, {len(goals)} and {len(outcomes)}"
        )
    for outcome in outcomes:
        if outcome not in get_args(Outcome):
            raise ValueError(f"outcomes must be among {get_args(Outcome)}, got {outcome!r}")


def _panel(
    world: World,
    trajectories: Trajectories,
    goals: Sequence[Point],
    outcomes: Sequence[Outcome],
    shown: Sequence[int],
    *,
    title: str,
    walkers: NDArray[np.float64] | None,
    goal_radius: float,
    size: int,
) -> NDArray[np.uint8]:
    """One picture with the paths of some episodes."""
    entries = _legend(title, outcomes, len(shown))
    canvas = Canvas(world, size=size, footer=HEIGHT, least_width=strip_width(entries))
    for walker in () if walkers is None else walkers.tolist():
        canvas.walker(walker)
    paths = {n: [(float(x), float(y)) for x, y in trajectories[n]] for n in shown}
    with canvas.layer():
        for x, y in {(float(goals[n][0]), float(goals[n][1])): n for n in shown}:
            canvas.disc(x, y, goal_radius, fill=GOAL_AREA, outline=GOAL_EDGE)
    # Successes first: they are many, and the failures above them are what one looks for.
    order = sorted(shown, key=lambda n: outcomes[n] != "success")
    for n in order:
        with canvas.layer():
            canvas.line(paths[n], OUTCOMES[outcomes[n]], 1.6)
    for n in order:
        canvas.disc(*goals[n], 0.09, fill=GOAL, outline=ROBOT_FRONT)
        if paths[n]:
            canvas.disc(*paths[n][0], 0.11, fill=ROBOT_FRONT)
            canvas.ring(*paths[n][0], 0.09, TRAIL)
    for n in order:
        if paths[n] and outcomes[n] != "success":
            mark = canvas.cross if outcomes[n] == "collision" else canvas.square
            mark(*paths[n][-1], (*OUTCOMES[outcomes[n]][:3], 255))
    write_strip(canvas, entries)
    return canvas.pixels()


def _legend(title: str, outcomes: Sequence[str], shown: int) -> list[Entry]:
    """The title, the number of episodes with each outcome, and of paths in the picture."""
    keys: list[Entry] = [
        Key(f"{name} {count}", (*color[:3], 255), _MARKS[name])
        for name, color in OUTCOMES.items()
        if (count := sum(outcome == name for outcome in outcomes))
    ]
    if shown < len(outcomes):
        keys.append(Title(f"{shown} shown"))
    return titled(title, *keys)
