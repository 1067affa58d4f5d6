"""An episode as pictures with scans, speeds and values, and as an animation for a page."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from mpfa_envs.checks import check_count, check_positive
from mpfa_envs.driver import Action, Driver, as_driver
from mpfa_envs.env.vector import VectorNavigationEnv
from mpfa_envs.evaluation.runs import drive_steps
from mpfa_envs.scene import colors
from mpfa_envs.scene.canvas import FINE, font
from mpfa_envs.scene.colors import GRID, LINES, PAPER, TEXT
from mpfa_envs.tasks.sampling import WorldTask


class Panel(NamedTuple):
    """Numbers of every step of an episode, on one pair of axes."""

    title: str
    lines: Mapping[str, Sequence[float]]
    """The numbers by the name of their line; one without a name needs no legend."""
    last: int | None = None
    """Number of steps shown, up to the present one; None: the whole episode."""


_LEFT, _RIGHT, _TOP, _BELOW = (FINE * n for n in (44, 14, 30, 22))
"""Margins of a panel in fine pixels."""
_SMALL: Final = 11


def render_traces(
    panels: Sequence[Panel],
    step: int,
    *,
    step_time: float,
    width: int = 240,
    height: int = 480,
) -> NDArray[np.uint8]:
    """Render panels with lines up to one step of an episode.

    Args:
        panels: The numbers of all steps; axes of height span all of them.
        step: Number of the step up to which the lines go.
        step_time: Time of a step [s].
        width: Of the picture [px].
        height: Of the picture [px]; the panels share it.

    Returns:
        Picture of shape ``[height, width, 3]``.

    Raises:
        ValueError: If a line has no number, or they differ in length.

    Examples:
        >>> from mpfa_envs.render import Panel, render_traces
        >>> render_traces([Panel("Q", {"": [1.0, 2.0, 4.0]})], 1, step_time=0.2).shape
        (480, 240, 3)
    """
    lengths = {len(line) for panel in panels for line in panel.lines.values()}
    if len(lengths) != 1 or 0 in lengths:
        raise ValueError(
            f"lines of panels must be equally long and not empty, got {sorted(lengths)}"
        )
    image = Image.new("RGB", (FINE * width, FINE * height), PAPER[:3])
    draw = ImageDraw.Draw(image)
    tall = FINE * height / len(panels)
    for number, panel in enumerate(panels):
        box = (_LEFT, number * tall + _TOP, FINE * width - _RIGHT, (number + 1) * tall - _BELOW)
        _draw_panel(draw, box, panel, step, step_time)
    small = image.reduce(FINE)
    return np.asarray(small, dtype=np.uint8).copy()


def _draw_panel(
    draw: ImageDraw.ImageDraw,
    box: tuple[float, float, float, float],
    panel: Panel,
    step: int,
    step_time: float,
) -> None:
    """One panel: frame, title, the ends of the axes, and the lines."""
    left, top, right, bottom = box
    values = np.array(list(panel.lines.values()), dtype=np.float64)
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-9:
        low, high = low - 0.5, high + 0.5
    count = values.shape[1] if panel.last is None else panel.last
    first = 0 if panel.last is None else max(step + 1 - panel.last, 0)

    def at(place: int, value: float) -> tuple[float, float]:
        share = (place - first) / max(count - 1, 1)
        return left + share * (right - left), bottom - (value - low) / (high - low) * (bottom - top)

    if low < 0.0 < high:
        draw.line([at(first, 0.0), at(first + count - 1, 0.0)], fill=GRID, width=FINE)
    draw.rectangle(box, outline=GRID, width=FINE)
    x = left
    draw.text((x, top - 9 * FINE), panel.title, fill=TEXT, font=font(13), anchor="lm")
    x += font(13).getlength(panel.title) + 10 * FINE
    for (name, line), color in zip(panel.lines.items(), LINES, strict=False):
        if name:
            draw.text((x, top - 9 * FINE), name, fill=color, font=font(13), anchor="lm")
            x += font(13).getlength(name) + 8 * FINE
        points = [at(place, line[place]) for place in range(first, step + 1)]
        if len(points) > 1:
            draw.line(points, fill=color, width=2 * FINE, joint="curve")
        (end_x, end_y), r = points[-1], 3 * FINE
        draw.ellipse([(end_x - r, end_y - r), (end_x + r, end_y + r)], fill=color)
    for value, y in ((high, top + 5 * FINE), (low, bottom - 5 * FINE)):
        text = f"{value:.{_digits(low, high)}f}"
        draw.text((left - 5 * FINE, y), text, fill=TEXT, font=font(_SMALL), anchor="rm")
    below = bottom + 10 * FINE
    for place, x, anchor in ((first, left, "lm"), (first + count - 1, right, "rm")):
        text = f"{place * step_time:.0f} s"
        draw.text((x, below), text, fill=TEXT, font=font(_SMALL), anchor=anchor)


def _digits(low: float, high: float) -> int:
    """Decimals by which the ends of an axis differ."""
    return min(max(1 - math.floor(math.log10(high - low)), 0), 3)


_LEAST_DELAY: Final = 20
"""Players of GIFs ignore shorter delays [ms]."""
_COLORS: Final = 64
"""Number of colors of an animation, at most half of which are of :mod:`mpfa_envs.scene.colors`."""


def write_animation(
    frames: Sequence[NDArray[np.uint8]],
    path: str | os.PathLike[str],
    *,
    frame_time: float = 0.1,
    speed: float = 2.0,
    most: int = 120,
) -> None:
    """Write an animation, faster than real and with no more frames than needed.

    Its palette holds the colors of this kit and those that the frames have most of; a goal that is
    small has its color nevertheless. Nothing is dithered: what stands still is stored once.

    Args:
        frames: Pictures, each of shape ``[height, width, 3]``.
        path: The GIF file.
        frame_time: Time between two frames [s].
        speed: How many times as fast as real.
        most: How many frames to keep at most, evenly spaced and with the last one.

    Raises:
        ValueError: If there is no frame, or an argument is out of its range.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from mpfa_envs.render import write_animation
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_animation([np.zeros((40, 50, 3), np.uint8)] * 2, f"{folder}/still.gif")
    """
    if not len(frames):
        raise ValueError("frames must not be empty")
    step = -(-len(frames) // check_count("most", most))
    delay = 1000 * step * check_positive("frame_time", frame_time) / check_positive("speed", speed)
    chosen = [*frames[:-1:step], frames[-1]]
    palette = _palette(chosen)
    pictures = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in chosen
    ]
    pictures[0].save(
        Path(path),
        save_all=True,
        append_images=pictures[1:],
        duration=max(round(delay), _LEAST_DELAY),
        loop=0,
        optimize=True,
    )


def _palette(pictures: Sequence[NDArray[np.uint8]]) -> Image.Image:
    """One palette for all pictures: colors of the kit that occur, and the most frequent others."""
    # Trails and maps are longest at the end, scans differ in the middle.
    samples = np.concatenate([pictures[n] for n in (0, len(pictures) // 2, -1)])
    found, counts = np.unique(samples.reshape(-1, 3), axis=0, return_counts=True)
    # A few pixels of one color are a mark; a few of many colors are blurred edges.
    there = {tuple(color) for color in found[counts > 3].tolist()}
    kept = sorted({color for color in _kit() if color in there})[: _COLORS // 2]
    most = Image.fromarray(samples).quantize(_COLORS - len(kept)).getpalette() or []
    palette = Image.new("P", (1, 1))
    values = [channel for color in kept for channel in color] + most[: 3 * (_COLORS - len(kept))]
    # What is left of the 256 entries repeats the first, so that no color comes out of nothing.
    palette.putpalette((values + values[:3] * 256)[:768])
    return palette


def _kit() -> list[tuple[int, int, int]]:
    """The opaque colors of the kit."""
    named = [value for name, value in vars(colors).items() if name.isupper()]
    return [
        value[:3]
        for value in named
        if isinstance(value, tuple) and all(isinstance(each, int) for each in value)
    ]


_RECENT = 10.0
"""Time span of the wheel speeds [s]."""


class Film(NamedTuple):
    """Pictures of an episode."""

    frames: list[NDArray[np.uint8]]
    """Each of shape ``[height, width, 3]``."""
    frame_time: float
    """Time between two of them [s]."""


def film_episode(
    policy: Action | Driver,
    episode: WorldTask,
    *,
    values: Callable[[NDArray[np.float32]], Any] | None = None,
    traces: bool = True,
    most: int = 120,
    seed: int = 0,
    **env_arguments: Any,
) -> Film:
    """Drive one episode and picture it.

    The robot, its lidar and its trail are seen from above, as
    :meth:`~mpfa_envs.NavigationEnv.render` gives them. Next to them are the speeds of its wheels in
    the last ten seconds and, if it is known, the value of what the robot sensed so far.

    Args:
        policy: As for :func:`~mpfa_envs.run_tasks`; its ``env_arguments`` hold unless given here.
        episode: The task and its world.
        values: From observations, ``[T, O]``, to their values, ``[T]``, such as Q.
        traces: If True, put speeds and values next to the picture.
        most: Greatest number of pictures, besides the last one: of a long episode every second
            step, every fourth, and so on.
        seed: Of the lidar's noise and the walkers.
        **env_arguments: Arguments of :class:`~mpfa_envs.VectorNavigationEnv`.

    Returns:
        Pictures, which :func:`write_animation` takes, and the time between two of them.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs import world_tasks
        >>> from mpfa_envs.render import film_episode
        >>> ahead = lambda observations: np.ones((len(observations), 2), np.float32)
        >>> task = world_tasks("A", episodes=1)[0]
        >>> film = film_episode(ahead, task, physics="kinematic", max_steps=4)
        >>> len(film.frames), film.frames[0].shape, film.frame_time
        (3, (480, 720, 3), 0.2)
    """
    check_count("most", most, least=2)
    snapshots: dict[int, Callable[[], NDArray[np.uint8]]] = {}
    stride, step_time = 1, 0.0
    wheels: list[tuple[float, float]] = []
    seen: list[NDArray[np.float32]] = []
    for step, drive in enumerate(drive_episode(policy, episode, seed=seed, **env_arguments)):
        env, ended = drive.env, drive.wheels is None
        step_time = env.config.time_step * env.config.action_repeat
        if step % stride == 0 or ended:
            (snapshots[step],) = env.snapshots()
        if len(snapshots) > most and not ended:
            stride *= 2
            snapshots = {at: each for at, each in snapshots.items() if at % stride == 0}
        seen.append(drive.observations)
        if drive.wheels is not None:
            wheels.append(drive.wheels)
    # Only now it is known which pictures are kept.
    pictures = {at: snapshot() for at, snapshot in snapshots.items()}
    if traces:
        worth = [] if values is None else np.reshape(values(np.concatenate(seen)), -1).tolist()
        panels = panels_of(wheels, worth, step_time=step_time)
        for at, each in pictures.items():
            beside = render_traces(panels, at, step_time=step_time, height=len(each))
            pictures[at] = np.concatenate((each, beside), 1)
    return Film(list(pictures.values()), step_time * stride)


class EpisodeStep(NamedTuple):
    """One decision of an episode, or its end."""

    env: VectorNavigationEnv
    """The environment, which can render it."""
    observations: NDArray[np.float32]
    """The observation, ``[1, O]``."""
    wheels: tuple[float, float] | None
    """The decision, speeds of the left and the right wheel [m/s]; None at the end."""
    info: dict[str, Any]
    """As the environment gives it, arrays of length one."""


def drive_episode(
    policy: Action | Driver, episode: WorldTask, *, seed: int = 0, **env_arguments: Any
) -> Iterator[EpisodeStep]:
    """Drive one episode; yield each decision before it is carried out, and the end."""
    arguments = {"contact": True, **getattr(policy, "env_arguments", {})}
    arguments |= episode.limit({**arguments, **env_arguments})
    arguments |= {**env_arguments, "world": episode.world, "render_mode": "rgb_array"}
    arguments["autoreset_mode"] = AutoresetMode.DISABLED
    tasks = [episode._replace(seed=seed)]
    with closing(VectorNavigationEnv(1, **arguments)) as env:
        for observations, info, actions, _ in drive_steps(env, as_driver(policy), tasks, [0]):
            wheels = None if actions is None else env.config.robot.wheel_speeds(actions[0])
            yield EpisodeStep(env, observations, wheels, info)


def panels_of(
    wheels: Sequence[tuple[float, float]], worth: Sequence[float], *, step_time: float
) -> list[Panel]:
    """The panels of an episode: values, if they are known, and wheel speeds [m/s]."""
    left, right = zip(*[*wheels, wheels[-1]], strict=True)
    last = max(round(_RECENT / step_time), 2)
    speeds = Panel("wheels [m/s]", {"left": left, "right": right}, last)
    return [Panel("Q", {"": worth}), speeds] if worth else [speeds]
