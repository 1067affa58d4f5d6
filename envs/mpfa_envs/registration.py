"""The ids of the environments, which gymnasium knows once this module is imported."""

from __future__ import annotations

from typing import Any

import gymnasium

from mpfa_envs.builtin_worlds import WORLDS

ENV_IDS = tuple(f"mpfa/Navigation-{name}-v1" for name in WORLDS)
"""The ids that ``gymnasium.make`` knows once this package is imported."""
VECTOR_ENV_IDS = tuple(
    f"mpfa/Navigation-{name}-v1"
    for name in ("Rooms", "Clutter", "Bars", "Fields", "Halls", "Mazes", "Mixed", "Crowd")
)
"""The ids of the generators' worlds, which only ``gymnasium.make_vec`` knows."""


def _refuse_one_robot(world: str, **_: Any) -> Any:
    raise gymnasium.error.Error(
        f"world {world!r} is new in each episode, which VectorNavigationEnv alone has: use "
        f"gymnasium.make_vec('mpfa/Navigation-{world.capitalize()}-v1', num_envs=1), or one world "
        f"of it: gymnasium.make('mpfa/Navigation-A-v1', world='{world}-7')"
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
