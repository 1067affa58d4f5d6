"""Colors that color-blind eyes, gray printers and small palettes keep apart.

Lines and marks have those of Okabe and Ito (2008), which differ for every common kind of color
blindness; values have viridis, whose lightness rises with the value.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Color = tuple[int, int, int, int]
"""Red, green, blue and opacity, each from 0 to 255."""

BLACK: Final = (0, 0, 0)
ORANGE: Final = (230, 159, 0)
SKY: Final = (86, 180, 233)
GREEN: Final = (0, 158, 115)
BLUE: Final = (0, 114, 178)
VERMILION: Final = (213, 94, 0)
PURPLE: Final = (204, 121, 167)

LINES: Final = (BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, BLACK)
"""Colors of lines, in order; yellow is too pale on white."""
GRAY: Final = (140, 140, 140)
METHODS: Final = {
    "mpfa_per": (BLUE, "-"),
    "mpfa_adaptive": (BLUE, "-."),
    "per": (ORANGE, "-"),
    "rank_per": (ORANGE, "--"),
    "uper": (ORANGE, "-."),
    "mpfa_plus": (GREEN, "-"),
    "td_reward": (GREEN, "--"),
    "raise": (GREEN, ":"),
    "averaged_ddpg": (GREEN, "-."),
    "mpf_per": (VERMILION, "-"),
    "ref_er": (VERMILION, "--"),
    "hvper": (VERMILION, ":"),
    "rud": (VERMILION, "-."),
    "her": (PURPLE, "-"),
    "td_loss": (PURPLE, "--"),
    "decay": (PURPLE, ":"),
    "mw": (PURPLE, "-."),
    "lap": (SKY, "-"),
    "pal": (SKY, "--"),
    "klper": (SKY, ":"),
    "geometric": (SKY, "-."),
    "la3p": (BLACK, "-"),
    "reaper": (BLACK, "--"),
    "ddpg_radam": (BLACK, ":"),
    "uniform": (GRAY, "-"),
    "ddpg": (GRAY, "-"),
    "uniform_halves": (GRAY, "--"),
    "cer": (GRAY, ":"),
}
"""Color and dash of each replay method, the same in every picture."""

PAPER: Final = (255, 255, 255, 255)
FLOOR: Final = (250, 249, 246, 255)
GRID: Final = (236, 234, 228, 255)
WALL: Final = (52, 58, 70, 255)
OBSTACLE: Final = (104, 114, 130, 255)
OBSTACLE_EDGE: Final = (70, 78, 92, 255)
TEXT: Final = (40, 44, 52, 255)
GOAL: Final = (*GREEN, 255)
GOAL_AREA: Final = (*GREEN, 46)
GOAL_EDGE: Final = (*GREEN, 190)
ROBOT: Final = (24, 26, 30, 255)
ROBOT_FRONT: Final = (255, 255, 255, 255)
RIVAL: Final = (*VERMILION, 255)
RAY: Final = (*SKY, 190)
RAY_AREA: Final = (*SKY, 34)
TRAIL: Final = (*BLUE, 255)
PATH: Final = (*PURPLE, 255)
MET: Final = (*PURPLE, 70)
WALKER: Final = (*ORANGE, 255)
WALKER_EDGE: Final = (138, 92, 0, 255)
ROUND: Final = (246, 217, 150, 255)
OUTCOMES: Final[dict[str, Color]] = {
    "success": (*BLUE, 190),
    "collision": (*VERMILION, 235),
    "timeout": (*PURPLE, 235),
    "standstill": (*ORANGE, 235),
}
"""Colors of paths by the end of their episode."""

VIRIDIS: Final = np.array(
    [
        (68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141),
        (39, 173, 129), (92, 200, 99), (170, 220, 50), (253, 231, 37),
    ],
    dtype=np.float64,
)  # fmt: skip


def viridis(shares: Any) -> NDArray[np.uint8]:
    """Colors of values from 0 to 1, from dark violet over green to yellow.

    Args:
        shares: Values, any shape; those beyond are clipped.

    Returns:
        Red, green and blue, shape ``[..., 3]``.

    Examples:
        >>> from mpfa_envs.render import viridis
        >>> viridis([0.0, 1.0]).tolist()
        [[68, 1, 84], [253, 231, 37]]
    """
    values = np.clip(np.nan_to_num(np.asarray(shares, dtype=np.float64)), 0.0, 1.0)
    places = np.linspace(0.0, 1.0, len(VIRIDIS))
    channels = [np.interp(values, places, channel) for channel in VIRIDIS.T]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def shares_of(values: Any, low: float, high: float) -> NDArray[np.float64]:
    """Places of values between two ends, from 0 to 1; 0.5 if the ends are the same."""
    spread = high - low
    numbers = np.asarray(values, dtype=np.float64)
    return (numbers - low) / spread if spread > 0.0 else np.full(numbers.shape, 0.5)
