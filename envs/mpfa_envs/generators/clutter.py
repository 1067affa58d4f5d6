"""Rooms full of boxes and cylinders of any size, which may stand against each other."""

from __future__ import annotations

import random

from mpfa_envs.generators.placing import between, cut_box, fit_cylinder, sample_size
from mpfa_envs.worlds.world import Box, Cylinder, World


def clutter(rng: random.Random, difficulty: float) -> World:
    """Sample a room of 8 to 14 m a side with boxes and cylinders anywhere in it.

    Boxes have sides of 0.3 to 2.5 m, cylinders, one obstacle in four, radii of 0.1 to 0.6 m. They
    may overlap and leave gaps of any width.

    Difficulty: 5 obstacles in 100 m² at 0, 16 at 1.
    """
    size = sample_size(rng, 8.0, 14.0)
    boxes: list[Box] = []
    cylinders: list[Cylinder] = []
    for _ in range(round(size[0] * size[1] * between(0.05, 0.16, difficulty))):
        x, y = (rng.uniform(-side / 2, side / 2) for side in size)
        if rng.random() < 0.25:
            radius = round(rng.uniform(0.1, 0.6), 3)
            cylinders.append(fit_cylinder(x, y, radius, size))
        else:
            box = cut_box(x, y, rng.uniform(0.3, 2.5), rng.uniform(0.3, 2.5), size)
            if box is not None:
                boxes.append(box)
    return World(name="clutter", size=size, boxes=tuple(boxes), cylinders=tuple(cylinders))
