"""The observation as one number: its cell in a grid over a few of its features."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.checks import check_count
from mpfa_envs.sensing.observation import observation_slices

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Binning:
    """Cells for a table of values.

    Features: the largest closeness of each of some groups of neighboring lidar sectors, the
    direction of the goal, and its distance.

    Args:
        groups: Number of groups of sectors, of sizes as equal as can be.
        closeness: Rising bounds between the bins of a closeness. With 0.25 m, at which closeness is
            one for the scripts' TurtleBot, 0.25 and 0.6 are 1 m and 0.42 m from its center.
        directions: Number of equal bins of the goal's direction; the first has its middle ahead.
        distances: Rising bounds between the bins of the goal's distance, as it is in the
            observation, where 1 is 10 m.
        sectors: Number of sectors of the lidar.
        observation_size: ``O``; what lies behind the known part of an observation is not looked at.

    Raises:
        ValueError: If a number is not positive, there are more groups than sectors, or bounds do
            not rise.

    Examples:
        >>> binning = Binning()
        >>> binning.cells, binning(np.zeros((5, 24), np.float32)).shape
        (972, (5,))
    """

    groups: int = 3
    closeness: tuple[float, ...] = (0.25, 0.6)
    directions: int = 12
    distances: tuple[float, ...] = (0.1, 0.25)
    sectors: int = 18
    observation_size: int = 24

    def __post_init__(self) -> None:
        for name in ("closeness", "distances"):
            bounds = tuple(float(bound) for bound in getattr(self, name))
            object.__setattr__(self, name, bounds)
            rising = all(low < high for low, high in pairwise(bounds))
            if not (rising and all(map(math.isfinite, bounds))):
                raise ValueError(f"{name} must be finite and rise, got {bounds}")
        for name in ("groups", "directions", "sectors", "observation_size"):
            object.__setattr__(self, name, check_count(name, getattr(self, name)))
        if self.groups > self.sectors:
            raise ValueError(f"groups must be at most {self.sectors} sectors, got {self.groups}")
        known = observation_slices(self.sectors)["angular_speed"].stop
        if self.observation_size < known:
            raise ValueError(f"observation_size must be {known} or more: {self.observation_size}")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of bins of each feature."""
        around = [len(self.closeness) + 1] * self.groups
        return (*around, self.directions, len(self.distances) + 1)

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(self.sizes)

    def __call__(self, observation: NDArray[np.floating]) -> NDArray[np.int64]:
        """Find the cells.

        Args:
            observation: Observations, shape ``[..., O]``.

        Returns:
            Numbers of cells, shape ``[...]``.
        """
        # In double precision, so that a saved table finds the cells that were trained.
        observation = np.asarray(observation, dtype=np.float64)
        parts = observation_slices(self.sectors)
        lidar = observation[..., parts["lidar"]]
        groups = np.array_split(lidar, self.groups, axis=-1)
        cosine, sine = np.moveaxis(observation[..., parts["goal_direction"]], -1, 0)
        turn = np.arctan2(sine, cosine) / (2.0 * math.pi) * self.directions
        distance = observation[..., parts["goal_distance"]][..., 0]
        bins = [np.digitize(group.max(-1), self.closeness) for group in groups]
        bins += [
            np.rint(turn).astype(np.int64) % self.directions,
            np.digitize(distance, self.distances),
        ]
        found: NDArray[np.int64] = np.ravel_multi_index(bins, self.sizes)
        return found
