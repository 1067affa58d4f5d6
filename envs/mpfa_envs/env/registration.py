"""The ids of the environments, which gymnasium knows once this module is imported."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import gymnasium

from mpfa_envs.checks import check_count
from mpfa_envs.tasks.reward import navigation_reward
from mpfa_envs.worlds.builtin import WORLDS

if TYPE_CHECKING:
    from mpfa_envs.env.vector import VectorNavigationEnv

_OF_TIME = ("robot", "max_steps", "time_step", "action_repeat")
_GENERATED = ("rooms", "clutter", "bars", "fields", "halls", "mazes", "mixed", "crowd")
_WORLD_OF = {
    f"mpfa/Navigation-{name if name in WORLDS else name.capitalize()}-v1": name
    for name in (*WORLDS, *_GENERATED)
}
ENV_IDS = tuple(_WORLD_OF)
"""The ids of worlds and of generators that ``gymnasium.make`` and ``gymnasium.make_vec`` know once
this package is imported; ``mpfa/Rooms-v1`` is that of ``regime=rooms``."""
ROOMS_TASK: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "world": "mixed",
        "robot": "kobuki",
        "physics": "kinematic",
        "progress": "shortest_path",
        "max_goal_distance": 20.0,
        "memory": "map",
        "clearance": 0.02,
        # A robot that can stand still has to be told that time costs something.
        "reward": partial(navigation_reward, step_cost=0.05),
    }
)
"""Arguments of :class:`~mpfa_envs.NavigationEnv` and :class:`~mpfa_envs.VectorNavigationEnv` for
the task of ``regime=rooms`` without a filter: those of ``mpfa/Rooms-v1``."""


def make_vector(
    num_envs: int, *, max_episode_steps: int | None = None, **arguments: Any
) -> VectorNavigationEnv:
    """Make the vector of an id, with the word of ``gymnasium.make`` for a time limit.

    ``max_episode_steps`` counts actions; None or -1: no other limit than ``max_steps``.
    """
    from mpfa_envs.env.config import TaskConfig
    from mpfa_envs.env.vector import VectorNavigationEnv

    if max_episode_steps is not None and max_episode_steps != -1:
        given = {name: arguments[name] for name in _OF_TIME if name in arguments}
        limits, actions = TaskConfig(**given), check_count("max_episode_steps", max_episode_steps)
        arguments["max_steps"] = min(limits.max_steps, actions * limits.action_repeat)
    return VectorNavigationEnv(num_envs, **arguments)


for _id, _arguments in {
    **{name: {"world": world} for name, world in _WORLD_OF.items()},
    "mpfa/Rooms-v1": dict(ROOMS_TASK),
}.items():
    # A second import, as after a reload, must not warn about an id that is known.
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="mpfa_envs.env.navigation:NavigationEnv",
            vector_entry_point="mpfa_envs.env.registration:make_vector",
            kwargs=_arguments,
        )
