"""Make the pictures of docs/pictures.md and of the README.

    python -m benchmarks.pictures                       of the shipped policies and kept rows
    python -m benchmarks.pictures episode --output runs/new    some, elsewhere
    python -m benchmarks.pictures --run runs/pictures   those that need a critic as well

``--run`` names the folder of a run with its checkpoint, which has the critic.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from benchmarks.study import read_curves
from mpfa_envs import (
    Policy,
    WorldTask,
    load_policy,
    make_navigation_env,
    make_planner,
)
from mpfa_envs.render import (
    draw_seeds,
    film_episode,
    plot_histograms,
    render_methods,
    render_samples,
    render_values,
    write_animation,
)
from mpfa_envs.render.charts import finish, new_figure
from torchrl_mpfa import (
    Learner,
    MPFASampler,
    SignalReplayBuffer,
    SignalTensorStorage,
)
from training.evaluating import Drivable, drive, filtered
from training.files import run_script
from training.pictures import Values, longest, trajectories_of
from training.run.checkpoints import load_learner, read_checkpoint
from training.run.evaluations import values_of
from training.run.updates import ReplayHistory

ROOT = Path(__file__).parents[1]
SHIPPED = "td3-rooms"
"""Policy of the pictures that need no critic."""
WORLD = "test"
MAZE = "mazes:test"
PHYSICS = "kinematic"
_FRAMES, _SPEED = 140, 4.0
"""Of the animation: pictures at most, and how many times as fast as real."""
_LONGEST = 15.0
"""Longest drive of the animation of the README [m]."""
_LEARNED = (
    ("C", "sparse", "sparse reward"),
    ("B", "dense", "dense reward"),
)
"""Of the learning curves: table of the study, its reward, and title."""
_TILE = 224
"""Side of one of three pictures in the column of a page, in which its words are legible [px]."""
_ROBOTS, _STEPS, _UPDATES = 16, 400, 300
"""Of the buffer whose samples are seen."""
_HOW: dict[str, Any] = {"seed": 0, "physics": PHYSICS, "progress": False}


@dataclass
class Run:
    """A run, and its critic."""

    folder: Path
    policy: Policy
    learner: Learner
    values: Values


def save(picture: Any, path: Path) -> None:
    """Write a picture with 256 colors, which is all that it needs."""
    image = Image.fromarray(picture).quantize(256, dither=Image.Dither.NONE)
    image.save(path, optimize=True)


def rooms(output: Path) -> None:
    """Paths in nine rooms of different kinds."""
    kinds = ("rooms", "clutter", "bars", "fields", "mazes")
    driver = filtered(load_policy(SHIPPED))
    driven = drive(driver, [f"{kind}:test" for kind in kinds], episodes=200, **_HOW)
    save(trajectories_of(driven, size=_TILE), output / "rooms.png")


def methods(output: Path) -> None:
    """Paths of a policy of today, one of the paper's task, and a planner, side by side."""
    drivers: dict[str, Drivable] = {
        "many rooms": filtered(load_policy(SHIPPED)),
        "four maps": load_policy("td3-paper"),
        "planner": make_planner("dwa"),
    }
    driven = {name: drive(each, [WORLD], episodes=20, **_HOW)[0] for name, each in drivers.items()}
    first = driven["many rooms"]
    picture = render_methods(
        first.tasks[0].world,
        {name: each.trails for name, each in driven.items()},
        [task.task.goal for task in first.tasks],
        {name: [result.outcome for result in each.results] for name, each in driven.items()},
        columns=3,
        size=_TILE,
    )
    save(picture, output / "methods.png")


def planners(output: Path) -> None:
    """Paths of a policy and of two planners to the goal of one maze, on simulated wheels."""
    of_robot: dict[str, Any] = {"robot": "kobuki"}
    drivers = {
        SHIPPED: filtered(load_policy(SHIPPED)),
        "mpc": filtered(make_planner("mpc", **of_robot)),
        "dwa --memory map": filtered(make_planner("dwa", memory="map", **of_robot)),
    }
    how = {**_HOW, "physics": "wheels"}
    driven = {name: drive(each, [MAZE], episodes=20, **how)[0] for name, each in drivers.items()}
    lengths = [result.shortest_path for result in driven[SHIPPED].results]
    fitting = [number for number, length in enumerate(lengths) if length <= _LONGEST]
    task = max(fitting, key=lengths.__getitem__)
    titled = {
        f"{name}, {drives.results[task].time_s:.0f} s": drives for name, drives in driven.items()
    }
    picture = render_methods(
        driven[SHIPPED].tasks[task].world,
        {name: [each.trails[task]] for name, each in titled.items()},
        [driven[SHIPPED].tasks[task].task.goal],
        {name: [each.results[task].outcome] for name, each in titled.items()},
        columns=3,
        size=_TILE,
    )
    save(picture, output / "planners.png")


def filmed(driver: Drivable) -> tuple[int, WorldTask]:
    """Number and task of the animation: of twenty in mazes the longest that fits in one look."""
    return longest(drive(driver, [MAZE], episodes=20, **_HOW), most=_LONGEST)


def episode(output: Path) -> None:
    """A drive through a maze of the test set to its goal, with lidar, map and trail."""
    driver = filtered(load_policy(SHIPPED))
    _write_film(driver, filmed(driver), output / "episode.gif")


def navigation(output: Path) -> None:
    """A drive of the paper's robot in the paper's test world, with lidar and trail."""
    policy = load_policy("td3-paper")
    found = longest(drive(policy, [WORLD], episodes=20, **_HOW))
    _write_film(policy, found, output / "navigation.gif")


def _write_film(driver: Drivable, found: tuple[int, WorldTask], path: Path) -> None:
    """Drive a task, by its number and itself, and write the pictures."""
    number, task = found
    how: dict[str, Any] = {"traces": False, "seed": number, "physics": PHYSICS}
    film = film_episode(driver, task, most=_FRAMES, **how)
    time = film.frame_time
    write_animation(film.frames, path, frame_time=time, speed=_SPEED, most=_FRAMES + 1)


def values(run: Run, output: Path) -> None:
    """Q and the actions all over the test world, all robots facing east."""
    picture = render_values(
        WORLD,
        goal=(3.0, 2.5),
        heading=0.0,
        values=run.values,
        actions=run.policy,
        title="TD3, MPFA-PER",
        size=640,
        **run.policy.env_arguments,
    )
    save(picture, output / "values.png")


def samples(run: Run, output: Path) -> None:
    """Transitions, their priorities and what is sampled, over the test world."""
    buffer, positions = filled_buffer(run.policy)
    counts = np.zeros(len(positions))
    for update in range(_UPDATES):
        batch = buffer.sample()
        if update >= _UPDATES // 2:
            counts += np.bincount(batch["index"].numpy(), minlength=len(positions))
        run.learner.update(batch)
        buffer.update_tensordict_priority(batch)
    priorities = buffer.sampler.priorities().numpy()
    save(render_samples(WORLD, positions, priorities, counts, size=_TILE), output / "samples.png")


def filled_buffer(policy: Policy) -> tuple[SignalReplayBuffer, Any]:
    """A buffer of what a policy does in the test world, and where it did that (x, y) [m]."""
    arguments = {**policy.env_arguments, "progress": "shortest_path"}
    env = make_navigation_env(WORLD, num_envs=_ROBOTS, seed=0, info_keys=["x", "y"], **arguments)

    steps, seen = [], env.reset()
    for _ in range(_STEPS):
        chosen = torch.as_tensor(policy(seen["observation"].numpy()))
        seen["action"] = (chosen + 0.3 * torch.randn(chosen.shape)).clamp(-1.0, 1.0)
        step, seen = env.step_and_maybe_reset(seen)
        steps.append(step.clone())
    env.close()
    rows: Any = torch.cat(steps)
    info = rows["next", "info"]
    positions = torch.cat((info["x"], info["y"]), dim=-1).numpy()
    kept = rows.select("observation", "action", "next").exclude(("next", "info"))
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(len(kept)), sampler=MPFASampler(len(kept)), batch_size=256
    )
    buffer.extend(kept)
    return buffer, positions


def histograms(run: Run, output: Path) -> None:
    """Signals, priorities and weights in the buffer of the run while it was trained."""
    history = ReplayHistory()
    history.load_state_dict(read_checkpoint(run.folder)["log"]["history"])
    plot_histograms(history.histograms(), output / "histograms.png")


def curves(output: Path) -> None:
    """Greedy success of three methods while they learn, of the rows that are kept."""
    names = {"mpfa_per": "MPFA-PER", "per": "PER", "uniform": "uniform replay"}
    figure, axes = new_figure(1, 2, panel=(3.6, 3.0), sharey=True)
    for axis, (table, reward, title) in zip(axes, _LEARNED, strict=True):
        curves = read_curves(table)
        runs = {name: curves[f"{reward}/td3/{method}"] for method, name in names.items()}
        draw_seeds(axis, runs, limits=(0.0, 1.0))
        axis.set(title=title, xlabel="actions")
    axes[0].set_ylabel("goals reached in unseen rooms")
    finish(figure, axes, output / "curves.png", dpi=192)


OF_RUN: dict[str, Callable[[Run, Path], None]] = {
    each.__name__: each for each in (values, samples, histograms)
}
OTHERS: dict[str, Callable[[Path], None]] = {
    each.__name__: each for each in (episode, navigation, curves, rooms, methods, planners)
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the pictures that are asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.pictures",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    every = [*OTHERS, *OF_RUN]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"among {', '.join(every)}")
    parser.add_argument("--run", type=Path, help=f"folder of a run, for {', '.join(OF_RUN)}")
    parser.add_argument("--output", type=Path, default=ROOT / "docs/images/pictures", help="folder")
    options = parser.parse_args(arguments)
    if unknown := [name for name in options.names if name not in every]:
        parser.error(f"there is no picture {unknown[0]!r}: choose from {', '.join(every)}")
    if options.run is None and (without := [name for name in options.names if name in OF_RUN]):
        parser.error(f"{without[0]} needs --run, the folder of a run with its critic")
    # TorchRL announces each storage.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.manual_seed(0)
    torch.set_num_threads(1)
    run = None
    if options.run is not None:
        try:
            policy = load_policy(options.run)
            learner, settings = load_learner(options.run, policy)
        except (ValueError, OSError) as error:
            parser.error(str(error))
        run = Run(options.run, policy, learner, values_of(learner, policy, settings))
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.names or (every if run else OTHERS):
        if name in OTHERS:
            OTHERS[name](options.output)
        elif run is not None:
            OF_RUN[name](run, options.output)
        print(f"made: {name}")
    return 0


if __name__ == "__main__":
    run_script(main)
