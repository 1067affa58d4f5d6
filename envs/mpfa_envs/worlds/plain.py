"""Worlds as plain values, to be saved and read back exactly."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from mpfa_envs.worlds.occupancy import OccupancyGrid
from mpfa_envs.worlds.shapes import Box, Cylinder, Polygon
from mpfa_envs.worlds.walker import Walker
from mpfa_envs.worlds.world import World


def world_to_plain(world: World) -> dict[str, Any]:
    """Turn a world into strings, numbers and lists."""
    return {
        "name": world.name,
        "size": list(world.size),
        "boxes": [list(box.bounds) for box in world.boxes],
        "cylinders": [[c.x, c.y, c.radius] for c in world.cylinders],
        "polygons": [[list(vertex) for vertex in polygon.vertices] for polygon in world.polygons],
        "start_regions": [list(box.bounds) for box in world.start_regions],
        "goal_regions": [list(box.bounds) for box in world.goal_regions],
        "walkers": [walker_to_plain(walker) for walker in world.walkers],
        **({} if world.occupancy is None else {"occupancy": world.occupancy.plain}),
    }


def walker_to_plain(walker: Walker) -> dict[str, Any]:
    """Turn a walker into plain values."""
    return {
        "radius": float(walker.radius),
        "speed": float(walker.speed),
        "behavior": walker.behavior,
        "waypoints": [list(point) for point in walker.waypoints],
    }


def world_from_plain(values: dict[str, Any]) -> World:
    """Make a world again from plain values."""
    try:
        return World(
            name=values["name"],
            size=(values["size"][0], values["size"][1]),
            boxes=tuple(Box(*edges) for edges in values["boxes"]),
            cylinders=tuple(Cylinder(*numbers) for numbers in values["cylinders"]),
            polygons=tuple(
                Polygon(tuple((x, y) for x, y in vertices)) for vertices in values["polygons"]
            ),
            start_regions=tuple(Box(*edges) for edges in values["start_regions"]),
            goal_regions=tuple(Box(*edges) for edges in values["goal_regions"]),
            walkers=tuple(
                Walker(**{**walker, "waypoints": tuple((x, y) for x, y in walker["waypoints"])})
                for walker in values["walkers"]
            ),
            occupancy=(
                OccupancyGrid.from_plain(values["occupancy"]) if "occupancy" in values else None
            ),
        )
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(f"worlds must hold the fields of a World, got {values!r}") from error


def fingerprint(world: World) -> str:
    """Name and hash of a world, which differs even from worlds with its name."""
    # 1 and 1.0 are the same number, but not the same text.
    values = json.loads(json.dumps(world_to_plain(world), default=float), parse_int=float)
    return f"{world.name} ({hashlib.sha256(json.dumps(values).encode()).hexdigest()[:8]})"
