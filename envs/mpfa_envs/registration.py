"""The ids of the environments, which gymnasium knows once this module is imported."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

import gymnasium

from mpfa_envs.builtin_worlds import WORLDS

ENV_IDS = tuple(f"mpfa/Navigation-{name}-v1" for name in WORLDS)
"""The ids that ``gymnasium.make`` knows once this package is imported."""
VECTOR_ENV_IDS = tuple(
    f"mpfa/Navigation-{name}-v1"
    for name in ("Rooms", "Clutter", "Bars", "Fields", "Halls", "Mazes", "Mixed", "Crowd")
)
"""The ids of the generators' worlds, which only ``gymnasium.make_vec`` knows."""
ROOMS_TASK: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "world": "mixed",
        "physics": "kinematic",
        "progress": "shortest_path",
        "max_goal_distance": 20.0,
        "memory": "map",
        "collision_distance": 0.23,
        "closeness_distance": 0.23,
    }
)
"""Arguments of :class:`~mpfa_envs.RoomsEnv` and :class:`~mpfa_envs.VectorNavigationEnv` for the
task of ``regime=rooms``, with its TurtleBot2: those of ``mpfa/Rooms-v1``.
"""


def _refuse_one_robot(world: str, **_: Any) -> Any:
    raise gymnasium.error.Error(
        f"world {world!r} is new in each episode, which NavigationEnv does not have: use "
        f"gymnasium.make_vec('mpfa/Navigation-{world.capitalize()}-v1', num_envs=1), or "
        f"gymnasium.make('mpfa/Rooms-v1', world={world!r}), or one world of it: "
        f"gymnasium.make('mpfa/Navigation-A-v1', world='{world}-7')"
    )


for _id, _name in zip(ENV_IDS, WORLDS, strict=True):
    # A second import, as after a reload, must not warn about an id that is known.
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="mpfa_envs.navigation:NavigationEnv",
            vector_entry_point="mpfa_envs.vector:VectorNavigationEnv",
            kwargs={"world": _name},
        )
for _id in VECTOR_ENV_IDS:
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="mpfa_envs.registration:_refuse_one_robot",
            vector_entry_point="mpfa_envs.vector:VectorNavigationEnv",
            kwargs={"world": _id.split("-")[1].lower()},
        )
if "mpfa/Rooms-v1" not in gymnasium.registry:
    gymnasium.register(
        "mpfa/Rooms-v1",
        entry_point="mpfa_envs.rooms:RoomsEnv",
        vector_entry_point="mpfa_envs.vector:VectorNavigationEnv",
        kwargs=dict(ROOMS_TASK),
    )
