"""Polygons cut into convex parts, which are all that PyBullet takes."""

from __future__ import annotations

from mpfa_envs.worlds.shapes import Point, Polygon


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
