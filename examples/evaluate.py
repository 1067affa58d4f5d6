"""Evaluate a trained policy on fixed start and goal pairs of a map.

    python examples/evaluate.py runs/demo --world A --episodes 100
    python examples/evaluate.py examples/policies/td3-mpfa_per.pt    one that comes with the project

Writes to the folder of the run, of another file to runs/evaluation-NAME, or to --output:
evaluation.json (the estimates), evaluation.csv (a row an episode), trajectories.png (the map with
every path) and episode.gif (one episode from above).
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import torch
from numpy.typing import NDArray
from PIL import Image

from environments import make_evaluation_env
from evaluation import (
    EpisodeResult,
    Interval,
    greedy,
    run_episode,
    run_episodes,
    summarize,
)
from mpfa_envs import NavigationEnv, Task, evaluation_pairs, render_trajectories
from records import load_policy, write_rows, write_text_atomically
from settings import Environment

_UNITS = {"time_s": "s", "path_length": "m", "min_clearance": "m"}
_GIF_FRAMES = 120


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policy", type=Path, help="policy.pt, or the folder of a run")
    parser.add_argument("--world", default="test", help="map or world file (default: test)")
    parser.add_argument("--episodes", type=int, default=200, help="number of pairs (default: 200)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the pairs (default: 0)")
    parser.add_argument("--output", type=Path, help="folder (default: that of the run)")
    parser.add_argument("--physics", choices=["wheels", "kinematic"], help="default: as trained")
    parser.add_argument("--no-gif", action="store_true", help="write no animation")
    return parser.parse_args(arguments)


def output_folder(policy: Path) -> Path:
    """Where results go unless the command line says: to the run that the policy is of."""
    if policy.is_dir():
        return policy
    return (
        policy.parent if policy.name == "policy.pt" else Path("runs") / f"evaluation-{policy.stem}"
    )


def print_table(summary: dict[str, Interval]) -> None:
    """Print the estimates with their intervals."""
    print(f"{'':14}{'mean':>9}   95 % interval")
    for name, interval in summary.items():
        unit = f" [{_UNITS[name]}]" if name in _UNITS else ""
        print(f"{name + unit:14}{interval.value:9.3f}   [{interval.low:.3f}, {interval.high:.3f}]")


def write_pictures(
    env: NavigationEnv,
    results: list[EpisodeResult],
    trajectories: list[NDArray],  # type: ignore[type-arg]
    tasks: list[Task],
    title: str,
    folder: Path,
) -> None:
    """Draw every path into one picture of the map."""
    outcomes = [
        "success" if r.success else "collision" if r.collision else "timeout" for r in results
    ]
    picture = render_trajectories(
        env.world,
        trajectories,
        [task.goal for task in tasks],
        outcomes,  # type: ignore[arg-type]
        title=title,
        size=640,
    )
    Image.fromarray(picture).save(folder / "trajectories.png")


def write_animation(frames: list[NDArray], path: Path) -> None:  # type: ignore[type-arg]
    """Write an animation of at most some hundred frames, twice as fast as real."""
    step = -(-len(frames) // _GIF_FRAMES)
    chosen = [Image.fromarray(frame) for frame in [*frames[:-1:step], frames[-1]]]
    # One palette and no dithering: what stands still is equal in all frames and stored once.
    palette = chosen[0].quantize(64)
    pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in chosen]
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=50 * step, loop=0, optimize=True
    )


def main(arguments: Sequence[str] | None = None) -> dict[str, Interval]:
    """Evaluate, print, write."""
    options = parse(arguments)
    torch.set_num_threads(1)  # One observation at a time: a second thread only costs.
    policy, state = load_policy(options.policy)
    folder = options.output or output_folder(options.policy)
    folder.mkdir(parents=True, exist_ok=True)
    settings = Environment(**state["environment"])
    settings.physics = options.physics or settings.physics
    env = make_evaluation_env(options.world, settings, render_mode="rgb_array")
    tasks = evaluation_pairs(options.world, options.episodes, options.seed, robot=settings.robot)
    act = greedy(policy)
    results, trajectories = run_episodes(env, act, tasks)
    summary = summarize(results)
    print(f"\n{options.policy} on map {options.world}, {len(tasks)} fixed pairs")
    print_table(summary)

    document = {
        **{name: _plain(interval.value) for name, interval in summary.items()},
        "episodes": len(results),
        "intervals": {name: [_plain(i.low), _plain(i.high)] for name, i in summary.items()},
        "world": str(options.world),
        "seed": options.seed,
        "physics": settings.physics,
        "trained": state["trained"],
    }
    write_text_atomically(json.dumps(document, indent=2) + "\n", folder / "evaluation.json")
    names = [entry.name for entry in fields(EpisodeResult)]
    write_rows([asdict(result) for result in results], names, folder / "evaluation.csv")
    write_pictures(env, results, trajectories, tasks, f"map {options.world}", folder)
    written = ["evaluation.json", "evaluation.csv", "trajectories.png"]
    if not options.no_gif:
        frames: list[NDArray] = []  # type: ignore[type-arg]
        run_episode(env, act, tasks[_longest(results)], 0, frames=frames)
        write_animation(frames, folder / "episode.gif")
        written.append("episode.gif")
    env.close()
    print("written: " + ", ".join(str(folder / name) for name in written))
    return summary


def _plain(value: float) -> float | None:
    """A mean over no episode is null: JSON has no NaN."""
    return None if math.isnan(value) else value


def _longest(results: list[EpisodeResult]) -> int:
    """The success with the longest way, which shows most; any episode if there is none."""
    reached = [r for r in results if r.success] or results
    return max(reached, key=lambda r: r.path_length).episode


if __name__ == "__main__":
    main()
