"""The ids of the environments, which gymnasium knows once this module is imported."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

import gymnasium

from mpfa_envs.worlds.builtin import WORLDS

_GENERATED = ("rooms", "clutter", "bars", "fields", "halls", "mazes", "mixed", "crowd")
_WORLD_OF = {
    f"mpfa/Navigation-{name if name in WORLDS else name.capitalize()}-v1": name
    for name in (*WORLDS, *_GENERATED)
}
ENV_IDS = tuple(_WORLD_OF)
"""The ids of worlds and of generators that ``gymnasium.make`` and ``gymnasium.make_vec`` know once
this package is imported; ``mpfa/Rooms-v1`` is that of ``regime=rooms`` for the paper's robot."""
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
"""Arguments of :class:`~mpfa_envs.NavigationEnv` and :class:`~mpfa_envs.VectorNavigationEnv` for
the task of ``regime=rooms`` for the paper's robot, without a filter and a cost of time: those of
``mpfa/Rooms-v1``."""

for _id, _arguments in {
    **{name: {"world": world} for name, world in _WORLD_OF.items()},
    "mpfa/Rooms-v1": dict(ROOMS_TASK),
}.items():
    # A second import, as after a reload, must not warn about an id that is known.
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="mpfa_envs.env.navigation:NavigationEnv",
            vector_entry_point="mpfa_envs.env.vector:VectorNavigationEnv",
            kwargs=_arguments,
        )
