"""A world in PyBullet: its ray test is a baseline of ours, and tests compare the two."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pybullet

from mpfa_envs.robots.simulation import Simulation
from mpfa_envs.worlds.shapes import Point, Polygon

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs import World

_HEIGHT = 1.0
"""Of walls and obstacles [m]."""
_THICKNESS = 0.2
"""Of walls [m]."""


class BulletWorld(Simulation):
    """A physics server with the walls and the obstacles of a world."""

    def __init__(self, world: World, *, time_step: float = 0.02, substeps: int = 1) -> None:
        super().__init__(time_step=time_step, substeps=substeps)
        self.obstacles: list[int] = []
        """The engine's numbers of the bodies that stand."""
        room, thick = world.room, _THICKNESS
        low_x, low_y = room.x_min - thick, room.y_min - thick
        high_x, high_y = room.x_max + thick, room.y_max + thick
        self._add_box(low_x, low_y, room.x_min, high_y)
        self._add_box(room.x_max, low_y, high_x, high_y)
        self._add_box(low_x, low_y, high_x, room.y_min)
        self._add_box(low_x, room.y_max, high_x, high_y)
        for box in world.boxes:
            self._add_box(box.x_min, box.y_min, box.x_max, box.y_max)
        for cylinder in world.cylinders:
            shape = pybullet.createCollisionShape(
                pybullet.GEOM_CYLINDER,
                radius=cylinder.radius,
                height=_HEIGHT,
                physicsClientId=self.client,
            )
            self._add_fixed(shape, cylinder.x, cylinder.y)
        for polygon in world.polygons:
            for part in convex_parts(polygon):
                corners = [[x, y, z] for z in (-_HEIGHT / 2, _HEIGHT / 2) for x, y in part.vertices]
                shape = pybullet.createCollisionShape(
                    pybullet.GEOM_MESH, vertices=corners, physicsClientId=self.client
                )
                self._add_fixed(shape, 0.0, 0.0)

    def _add_box(self, x_min: float, y_min: float, x_max: float, y_max: float) -> None:
        halves = [(x_max - x_min) / 2, (y_max - y_min) / 2, _HEIGHT / 2]
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=halves, physicsClientId=self.client
        )
        self._add_fixed(shape, (x_min + x_max) / 2, (y_min + y_max) / 2)

    def _add_fixed(self, shape: int, x: float, y: float) -> None:
        body = pybullet.createMultiBody(
            baseMass=0,
            baseCollisionShapeIndex=shape,
            basePosition=[x, y, _HEIGHT / 2],
            physicsClientId=self.client,
        )
        self.obstacles.append(body)

    def cast_rays(
        self, x: float, y: float, angles: NDArray[np.float64], *, reach: float
    ) -> NDArray[np.float64]:
        """Ranges of rays at these angles in the room [m], ``[rays]``, by the engine's ray test."""
        start = np.tile([x, y, 0.3], (len(angles), 1))
        end = start.copy()
        end[:, 0] += reach * np.cos(angles)
        end[:, 1] += reach * np.sin(angles)
        hits: Any = pybullet.rayTestBatch(start, end, physicsClientId=self.client)
        return np.array([hit[2] for hit in hits]) * reach

    def gap(self, body: int) -> float:
        """Distance from a body's base to the nearest wall or obstacle [m]."""
        return min(
            contact[8]
            for other in self.obstacles
            for contact in pybullet.getClosestPoints(
                body, other, 1.0, linkIndexA=-1, physicsClientId=self.client
            )
        )


def convex_parts(polygon: Polygon) -> list[Polygon]:
    """Cut off ears, corners that bulge with no other vertex in their triangle, one by one."""
    left = list(polygon.vertices)
    parts: list[Polygon] = []
    while not Polygon(tuple(left)).is_convex:
        ear = next(i for i in range(len(left)) if _is_ear(left, i))
        parts.append(Polygon((left[ear - 1], left[ear], left[(ear + 1) % len(left)])))
        del left[ear]
    return [*parts, Polygon(tuple(left))]


def _is_ear(vertices: list[Point], at: int) -> bool:
    """Return True if a vertex can be cut off, with the line between its neighbors all inside."""
    a, b, c = vertices[at - 1], vertices[at], vertices[(at + 1) % len(vertices)]
    if _turn(a, b, c) <= 0.0:
        return False
    return not any(
        vertex not in (a, b, c)
        and _turn(a, b, vertex) >= 0.0
        and _turn(b, c, vertex) >= 0.0
        and _turn(c, a, vertex) >= 0.0
        for vertex in vertices
    )


def _turn(a: Point, b: Point, c: Point) -> float:
    """Positive if c lies to the left of the line from a to b."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
