"""Rooms with walls that meet: bars, Ls, and pockets that open to one side."""

from __future__ import annotations

import random

from mpfa_envs.generators.placing import between, cut_box, sample_size
from mpfa_envs.worlds.world import Box, World


def bars(rng: random.Random, difficulty: float) -> World:
    """Sample a room of 8 to 14 m a side with bars, Ls and Us, of which some meet.

    Walls are 0.15 to 0.5 m thick and 1 to 4 m long. Half of the pieces are straight, a quarter each
    are an L, which has a corner, and a U, a pocket that a robot has to leave as it came.

    Difficulty: 5 pieces in 100 m² at 0, 12 at 1.
    """
    size = sample_size(rng, 8.0, 14.0)
    boxes: list[Box | None] = []
    for _ in range(round(size[0] * size[1] * between(0.05, 0.12, difficulty))):
        x, y = (rng.uniform(-side / 2, side / 2) for side in size)
        length, thick = rng.uniform(1.0, 4.0), rng.uniform(0.15, 0.5)
        arm = rng.uniform(0.4, 0.9) * length
        arms = rng.choice((0, 0, 1, 2))
        lies, side, end = rng.random() < 0.5, rng.choice((-1, 1)), rng.choice((-1, 1))
        # The bar lies along one axis; its arms leave one end, or both, to one side.
        pieces = [(0.0, 0.0, length, thick)]
        for sign in (end, -end)[:arms]:
            along, across = sign * (length - thick) / 2, side * (arm - thick) / 2
            pieces.append((along, across, thick, arm))
        for along, across, width, depth in pieces:
            if lies:
                boxes.append(cut_box(x + along, y + across, width, depth, size))
            else:
                boxes.append(cut_box(x + across, y + along, depth, width, size))
    return World(name="bars", size=size, boxes=tuple(box for box in boxes if box is not None))
