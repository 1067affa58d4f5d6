"""Episodes in a window while they are driven."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from mpfa_envs import WorldTask
from mpfa_envs.render import drive_episode
from mpfa_envs.scene.scene import Window
from training.evaluating import Drivable

_PAUSE = 1.0
"""For which the end of an episode is shown [s]."""


class Watched(NamedTuple):
    """The end of an episode that was watched to its end."""

    world: str
    outcome: str
    time_s: float


def watch(
    policy: Drivable, tasks: Sequence[WorldTask], *, speed: float = 1.0, **env_arguments: Any
) -> Iterator[Watched]:
    """Drive tasks one after another in a window, until it is closed.

    The key N starts the next task, Escape ends.
    """
    window: Window | None = None
    for number, task in enumerate(tasks):
        for step in drive_episode(policy, task, seed=number, **env_arguments):
            env = step.env
            if window is None:
                fps = speed / (env.config.time_step * env.config.action_repeat)
                window = Window("N: next task   Escape: end", fps=fps)
            (picture,) = env.render() or ()
            if not window.show(picture) or "n" in window.pressed:
                break
            if step.wheels is None:
                yield _end(task.world.name, step.info)
                for _ in range(round(_PAUSE / (env.config.time_step * env.config.action_repeat))):
                    window.show(picture)
        if window is not None and window.closed:
            break
    if window is not None:
        window.close()


def _end(world: str, info: dict[str, Any]) -> Watched:
    ends = ("success", "collision", "timeout")
    outcome = next(name for name in ends if info[name][0])
    return Watched(world, outcome, float(info["sim_time"][0]))
