"""An episode as pictures, with the robot's scans, speeds and values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mpfa_envs.checks import check_count
from mpfa_envs.env.vector import VectorNavigationEnv
from mpfa_envs.evaluation.runs import Action, Driver, as_driver, drive_steps
from mpfa_envs.render.traces import Panel, render_traces
from mpfa_envs.tasks.sampling import WorldTask

_RECENT = 10.0
"""Time span of the wheel speeds [s]."""


class Film(NamedTuple):
    """Pictures of an episode."""

    frames: list[NDArray[np.uint8]]
    """Each of shape ``[height, width, 3]``."""
    frame_time: float
    """Time between two of them [s]."""


def film_episode(
    policy: Action | Driver,
    episode: WorldTask,
    *,
    values: Callable[[NDArray[np.float32]], Any] | None = None,
    traces: bool = True,
    most: int = 120,
    seed: int = 0,
    **env_arguments: Any,
) -> Film:
    """Drive one episode and picture it.

    The robot, its lidar and its trail are seen from above, as
    :meth:`~mpfa_envs.NavigationEnv.render` gives them. Next to them are the speeds of its wheels in
    the last ten seconds and, if it is known, the value of what the robot sensed so far.

    Args:
        policy: As for :func:`~mpfa_envs.run_tasks`; its ``env_arguments`` hold unless given here.
        episode: The task and its world.
        values: From observations, ``[T, O]``, to their values, ``[T]``, such as Q.
        traces: If True, put speeds and values next to the picture.
        most: Greatest number of pictures, besides the last one: of a long episode every second
            step, every fourth, and so on.
        seed: Of the lidar's noise and the walkers.
        **env_arguments: Arguments of :class:`~mpfa_envs.VectorNavigationEnv`.

    Returns:
        Pictures, which :func:`write_animation` takes, and the time between two of them.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs import world_tasks
        >>> from mpfa_envs.render import film_episode
        >>> ahead = lambda observations: np.ones((len(observations), 2), np.float32)
        >>> task = world_tasks("A", episodes=1)[0]
        >>> film = film_episode(ahead, task, physics="kinematic", max_steps=4)
        >>> len(film.frames), film.frames[0].shape, film.frame_time
        (3, (480, 720, 3), 0.2)
    """
    check_count("most", most, least=2)
    snapshots: dict[int, Callable[[], NDArray[np.uint8]]] = {}
    stride, step_time = 1, 0.0
    wheels: list[tuple[float, float]] = []
    seen: list[NDArray[np.float32]] = []
    for step, drive in enumerate(drive_episode(policy, episode, seed=seed, **env_arguments)):
        env, ended = drive.env, drive.wheels is None
        step_time = env.config.time_step * env.config.action_repeat
        if step % stride == 0 or ended:
            (snapshots[step],) = env.snapshots()
        if len(snapshots) > most and not ended:
            stride *= 2
            snapshots = {at: each for at, each in snapshots.items() if at % stride == 0}
        seen.append(drive.observations)
        if drive.wheels is not None:
            wheels.append(drive.wheels)
    # Only now it is known which pictures are kept.
    pictures = {at: snapshot() for at, snapshot in snapshots.items()}
    if traces:
        worth = [] if values is None else np.reshape(values(np.concatenate(seen)), -1).tolist()
        panels = panels_of(wheels, worth, step_time=step_time)
        for at, each in pictures.items():
            beside = render_traces(panels, at, step_time=step_time, height=len(each))
            pictures[at] = np.concatenate((each, beside), 1)
    return Film(list(pictures.values()), step_time * stride)


class EpisodeStep(NamedTuple):
    """One decision of an episode, or its end."""

    env: VectorNavigationEnv
    """The environment, which can render it."""
    observations: NDArray[np.float32]
    """The observation, ``[1, O]``."""
    wheels: tuple[float, float] | None
    """The decision, speeds of the left and the right wheel [m/s]; None at the end."""
    info: dict[str, Any]
    """As the environment gives it, arrays of length one."""


def drive_episode(
    policy: Action | Driver, episode: WorldTask, *, seed: int = 0, **env_arguments: Any
) -> Iterator[EpisodeStep]:
    """Drive one episode; yield each decision before it is carried out, and the end."""
    arguments = {"contact": True, **getattr(policy, "env_arguments", {})}
    arguments |= episode.limit({**arguments, **env_arguments})
    arguments |= {**env_arguments, "world": episode.world, "render_mode": "rgb_array"}
    arguments["autoreset_mode"] = AutoresetMode.DISABLED
    tasks = [episode._replace(seed=seed)]
    with closing(VectorNavigationEnv(1, **arguments)) as env:
        for observations, info, actions, _ in drive_steps(env, as_driver(policy), tasks, [0]):
            wheels = None if actions is None else env.config.robot.wheel_speeds(actions[0])
            yield EpisodeStep(env, observations, wheels, info)


def panels_of(
    wheels: Sequence[tuple[float, float]], worth: Sequence[float], *, step_time: float
) -> list[Panel]:
    """The panels of an episode: values, if they are known, and wheel speeds [m/s]."""
    left, right = zip(*[*wheels, wheels[-1]], strict=True)
    last = max(round(_RECENT / step_time), 2)
    speeds = Panel("wheels [m/s]", {"left": left, "right": right}, last)
    return [Panel("Q", {"": worth}), speeds] if worth else [speeds]
