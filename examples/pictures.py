"""Make the pictures of docs/pictures.md, from a run in ``regime=rooms`` and the policies here.

    python examples/pictures.py RUN                      all of them
    python examples/pictures.py RUN values episode       some
    python examples/pictures.py RUN --output runs/pictures

RUN is the folder of a run with its checkpoint, which has the critic.
"""

from __future__ import annotations

import argparse
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from mpfa_envs import (
    Policy,
    WorldTask,
    load_policy,
    make_navigation_env,
    make_planner,
    world_tasks,
)
from mpfa_envs.render import (
    film_episode,
    plot_seeds,
    render_methods,
    render_samples,
    render_values,
    write_animation,
)
from navigation import files
from navigation.evaluating import Drivable, drive
from navigation.pictures import Values, trajectories_of
from navigation.records import read_table
from navigation.training.values import load_learner, values_of
from torchrl_mpfa import (
    Learner,
    MPFASampler,
    SignalReplayBuffer,
    SignalTensorStorage,
)

ROOT = Path(__file__).parents[1]
POLICIES = Path(__file__).parent / "policies"
WORLD = "test"
MAZE = "mazes:test"
_ROBOTS, _STEPS, _UPDATES = 16, 400, 300
"""Of the buffer whose samples are seen."""


@dataclass
class Run:
    """What pictures are made of."""

    policy: Policy
    learner: Learner
    values: Values
    output: Path

    def save(self, picture: Any, name: str) -> None:
        """Write a picture with 256 colors, which is all that it needs."""
        image = Image.fromarray(picture).quantize(256, dither=Image.Dither.NONE)
        image.save(self.output / f"{name}.png", optimize=True)


def rooms(run: Run) -> None:
    """Paths in nine rooms of different kinds."""
    kinds = ("rooms", "clutter", "bars", "fields", "mazes")
    driven = [
        drive(run.policy, f"{kind}:test", episodes=200, seed=0, physics="kinematic", progress=False)
        for kind in kinds
    ]
    run.save(trajectories_of(driven), "rooms")


def methods(run: Run) -> None:
    """Paths of a policy of today, one of the paper's task, and a planner, side by side."""
    drivers: dict[str, Drivable] = {
        "TD3, many rooms": run.policy,
        "TD3, one map": load_policy(POLICIES / "td3-mpfa_per.npz"),
        "dynamic window": make_planner("dwa"),
    }
    how: dict[str, Any] = {"episodes": 20, "seed": 0, "physics": "kinematic", "progress": False}
    driven = {name: drive(each, WORLD, **how) for name, each in drivers.items()}
    first = driven["TD3, many rooms"]
    run.save(
        render_methods(
            first.tasks[0].world,
            {name: each.trails for name, each in driven.items()},
            [task.task.goal for task in first.tasks],
            {name: [result.outcome for result in each.results] for name, each in driven.items()},
            columns=3,
        ),
        "methods",
    )


def values(run: Run) -> None:
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
    run.save(picture, "values")


def samples(run: Run) -> None:
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
    run.save(render_samples(WORLD, positions, priorities, counts), "samples")


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


def seeds(run: Run) -> None:
    """Greedy success of three methods, three seeds each, of the kept runs."""
    curves: dict[str, list[Any]] = {}
    for file in sorted((ROOT / "docs" / "results").glob(f"ddpg-*/{files.EVALUATIONS}")):
        found = read_table(file)
        name = file.parent.name.rsplit("-", 1)[0]
        curves.setdefault(name, []).append((found["total_steps"], found["success"]))
    plot_seeds(curves, run.output / "seeds.png", ylabel="greedy success", band="range")


def episode(run: Run) -> None:
    """The way through a maze of the test set, with lidar, trail, Q and speeds."""
    task = longest_task(world_tasks(MAZE, episodes=20))
    film = film_episode(run.policy, task, values=run.values)
    write_animation(film.frames, run.output / "episode.gif", frame_time=film.frame_time, speed=4.0)


def longest_task(tasks: Sequence[WorldTask]) -> WorldTask:
    """The task whose goal is farthest from its start."""
    return max(tasks, key=lambda each: math.dist(each.task.start[:2], each.task.goal))


PICTURES: dict[str, Callable[[Run], None]] = {
    each.__name__: each for each in (rooms, methods, values, samples, seeds, episode)
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the pictures that are asked for.

    Args:
        arguments: The command line.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="folder of a run")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"among {', '.join(PICTURES)}")
    parser.add_argument("--output", type=Path, default=ROOT / "docs/images/pictures", help="folder")
    options = parser.parse_args(arguments)
    if unknown := [name for name in options.names if name not in PICTURES]:
        parser.error(f"there is no picture {unknown[0]!r}: choose from {', '.join(PICTURES)}")
    # TorchRL announces each storage.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    torch.manual_seed(0)
    torch.set_num_threads(1)
    try:
        policy = load_policy(options.run)
        learner, settings = load_learner(options.run, policy)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    options.output.mkdir(parents=True, exist_ok=True)
    run = Run(policy, learner, values_of(learner, policy, settings), options.output)
    for name in options.names or PICTURES:
        PICTURES[name](run)
        print(f"made: {name}")


if __name__ == "__main__":
    main()
