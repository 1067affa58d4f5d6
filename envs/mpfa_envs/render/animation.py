"""Animations of episodes, small enough for a page."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mpfa_envs.checks import check_count, check_positive
from mpfa_envs.scene import colors

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
