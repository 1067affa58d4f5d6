"""Evaluate a policy or a planner between fixed starts and goals, in worlds or those of generators.

    python examples/evaluate.py runs/demo --worlds A --episodes 100
    python examples/evaluate.py runs/demo --worlds test rooms:100-109 bars:test barn
    python examples/evaluate.py runs/demo --worlds all        all test worlds in which nothing moves
    python examples/evaluate.py examples/policies/td3-mpfa_per.npz    comes with the project
    python examples/evaluate.py --policy dwa --worlds bars:validation    a planner in its place

Prints a row for each world or generator and their total. Writes to the folder
``evaluation-WORLDS`` in that of the run, for another file or a planner to runs/evaluation-NAME, or
to --output:
summary.csv (the rows with their intervals), evaluation.json (their numbers), episodes.csv (a row
an episode), settings.json (what was asked for, and a policy's card), trajectories.png (the
ways in up to nine worlds) and episode.gif (the longest one from above).
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from mpfa_envs import (
    GENERATORS,
    PLANNERS,
    EpisodeResult,
    Policy,
    RobotNoise,
    World,
    load_policy,
    make_planner,
    render_trajectories,
)
from mpfa_envs.render import tiled, write_animation
from navigation import files
from navigation.evaluating import Drivable, Drives, drive, film, summary_row
from navigation.records import as_table, write_table
from navigation.worlds import parse_worlds, world_name, worlds_label
from torchrl_mpfa.saving import write_text_atomically

EVALUATION = "evaluation.json"
_PICTURED = 9
"""Worlds in a picture at most."""
_DOCUMENTED = (
    *("success", "collision", "timeout", "spl", "time_s"),
    *("path_length", "plan_s", "decision_s"),
)
_COLUMNS = {"success": "{:.1%}", "collision": "{:.1%}", "timeout": "{:.1%}", "spl": "{:.3f}"}
_LENGTHS = {"time_s": "{:.1f}", "path_length": "{:.2f}", "min_clearance": "{:.3f}"}
_ENCOUNTERS = {
    "walker_distance": "{:.3f}",
    "intrusion_time": "{:.1f}",
    "time_to_collision": "{:.2f}",
}
"""What there is where people walk."""
_MILLISECONDS = {"plan_s": "{:.2f}", "decision_s": "{:.2f}"}


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "path", type=Path, nargs="?", help="policy.npz of a trained policy, or the folder of a run"
    )
    parser.add_argument(
        "--policy",
        choices=list(PLANNERS),
        help="a planner in its place: "
        + "; ".join(f"{name}, {what}" for name, what in PLANNERS.items()),
    )
    parser.add_argument(
        "--memory", choices=["none", "map"], default="none", help="map: dwa sees the way on its map"
    )
    parser.add_argument(
        "--worlds",
        nargs="+",
        default=["test"],
        help="names, world files, spans (rooms:100-109), splits (bars:test), barn, or all",
    )
    parser.add_argument(
        "--episodes", type=int, help="for each (default: 200 in a world, 400 of a generator)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of pairs and ants (default: 0)")
    parser.add_argument("--output", type=Path, help="folder (default: in that of the run)")
    parser.add_argument(
        "--physics",
        choices=["wheels", "kinematic"],
        help="default: as trained; of a planner kinematic",
    )
    parser.add_argument(
        "--noise",
        type=read_noise,
        metavar="NAME=VALUE,...",
        help="errors of a robot: range_noise, dropout, slip, latency, drift (default: none)",
    )
    parser.add_argument("--no-pictures", action="store_true", help="write tables alone")
    options = parser.parse_args(arguments)
    for name, least in (("episodes", 1), ("seed", 0)):
        value = getattr(options, name)
        if value is not None and value < least:
            parser.error(f"--{name} must be at least {least}, got {value}")
    if (options.path is None) == (options.policy is None):
        parser.error("give either the path of a trained policy or --policy with a planner")
    if options.memory != "none" and options.policy != "dwa":
        parser.error(f"--memory {options.memory} is for --policy dwa alone")
    try:
        options.names = parse_worlds(options.worlds)
        options.loaded = load_driver(options)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    return options


def read_noise(words: str) -> RobotNoise:
    """What ``--noise slip=0.1,latency=1`` says."""
    try:
        values = {
            name: float(value) for name, _, value in (w.partition("=") for w in words.split(","))
        }
        if "latency" in values and values["latency"].is_integer():
            values["latency"] = int(values["latency"])
        return RobotNoise(**values)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def load_driver(options: argparse.Namespace) -> Drivable:
    """The policy or the planner that the command line names."""
    if options.policy is None:
        return load_policy(options.path)
    return make_planner(options.policy, memory=options.memory, seed=options.seed)


def name_of(options: argparse.Namespace) -> str:
    """What is evaluated: the path of a policy, or a planner and what it remembers."""
    if options.policy is None:
        return str(options.path)
    return str(options.policy) if options.memory == "none" else f"{options.policy}-map"


def output_folder(options: argparse.Namespace) -> Path:
    """Where results go unless the command line says: each choice of worlds has its own folder."""
    name = f"evaluation-{worlds_label(options.worlds)}"
    policy = options.path
    if policy is None:
        return Path("runs") / f"evaluation-{name_of(options)}" / name
    if policy.is_dir():
        return policy / name
    if policy.name == files.POLICY:
        return policy.parent / name
    return Path("runs") / f"evaluation-{policy.stem}" / name


def printed(summary: pd.DataFrame) -> str:
    """The table on the screen: estimates, and the interval of success."""
    table = summary[["world", "episodes"]].copy()
    for name, form in {**_COLUMNS, **_LENGTHS, **_MILLISECONDS, **_ENCOUNTERS}.items():
        if name in summary:
            shown, scale = (name, 1.0) if name not in _MILLISECONDS else (f"{name[:-2]}_ms", 1e3)
            values = (scale * summary[name]).map(form.format)
            table[shown] = values.where(summary[name].notna(), "")
    ends = zip(summary["success_low"], summary["success_high"], strict=True)
    table.insert(3, "95 %", [f"[{low:.1%}, {high:.1%}]" for low, high in ends])
    return table.to_string(index=False)


def write_pictures(policy: Drivable, driven: Sequence[Drives], folder: Path, **how: Any) -> None:
    """Nine worlds with the ways in them, and one episode as an animation.

    Args:
        policy: The policy, or a planner.
        driven: What it did, one for each row of the table.
        folder: Where the pictures go.
        **how: Passed to :func:`navigation.evaluating.film`.
    """
    # One world of each row, then a second one of each, and so on.
    in_turn = zip_longest(*map(worlds_in, driven))
    worlds = [each for nth in in_turn for each in nth if each is not None]
    size = 640 if len(worlds) == 1 else 360
    pictures = [picture_of(world, drives, size=size) for world, drives in worlds[:_PICTURED]]
    Image.fromarray(tiled(pictures)).save(folder / "trajectories.png")
    # The success with the longest way shows most; any episode if there is none.
    episodes = [
        (result, task, number)
        for each in driven
        for number, (result, task) in enumerate(zip(each.results, each.tasks, strict=True))
    ]
    reached = [each for each in episodes if each[0].success]
    _, shown, number = max(reached or episodes, key=lambda each: each[0].path_length)
    # The number of a task is the seed of its walkers, and of the noise.
    write_animation(film(policy, shown, seed=number, **how), folder / "episode.gif")


def worlds_in(drives: Drives) -> list[tuple[World, Drives]]:
    """Each world of some drives, with the drives."""
    return [(world, drives) for world in {e.world.name: e.world for e in drives.tasks}.values()]


def picture_of(world: World, drives: Drives, *, size: int) -> NDArray[np.uint8]:
    """The ways in one world, shape ``[size, size, 3]``."""
    numbers = drives.of_world(world.name)
    return render_trajectories(
        world,
        [drives.trails[n] for n in numbers],
        [drives.tasks[n].task.goal for n in numbers],
        [end_of(drives.results[n]) for n in numbers],
        title=f"world {world.name}",
        size=size,
    )


def end_of(result: EpisodeResult) -> Literal["success", "collision", "timeout"]:
    """How an episode ended, in a word."""
    if result.success:
        return "success"
    return "collision" if result.collision else "timeout"


def as_document(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The rows as one document: the total, and each generator and each world under its name."""

    def entries(row: Mapping[str, Any]) -> dict[str, Any]:
        # JSON has no NaN, which the time is where no episode succeeds.
        values = ((name, float(row[name])) for name in _DOCUMENTED)
        kept = {name: None if math.isnan(value) else value for name, value in values}
        return {"episodes": int(row["episodes"]), **kept}

    document: dict[str, Any] = {**entries(rows[-1]), "generators": {}, "worlds": {}}
    for row in rows:
        generator, _, split = str(row["world"]).partition("-")
        if generator in GENERATORS and split in ("test", "validation"):
            # Other than test worlds are named, lest both of a generator have one name.
            name = generator if split == "test" else f"{generator}:{split}"
            document["generators"][name] = entries(row)
        elif row["world"] != "total":
            document["worlds"][row["world"]] = entries(row)
    return document


def main(arguments: Sequence[str] | None = None) -> pd.DataFrame:
    """Evaluate, print, write.

    Args:
        arguments: The command line.

    Returns:
        A row for each world, and the total.
    """
    options = parse(arguments)
    policy: Drivable = options.loaded
    folder = options.output or output_folder(options)
    asked = {"episodes": options.episodes, "seed": options.seed, "physics": options.physics}
    results: list[EpisodeResult] = []
    driven: list[Drives] = []
    rows = []
    with files.lock(folder):
        for world in options.names:
            drives = drive(
                policy, world, noise=options.noise, progress=not options.no_pictures, **asked
            )
            results += drives.results
            driven.append(drives)
            rows.append({"world": world_name(world), **summary_row(drives.results)})
        if not options.no_pictures:
            write_pictures(policy, driven, folder, physics=options.physics, noise=options.noise)
        if len(rows) > 1:
            rows.append({"world": "total", **summary_row(results)})
        summary = pd.DataFrame(rows)
        write_table(summary, folder / "summary.csv")
        write_table(as_table(results, EpisodeResult), folder / files.EPISODES)
        write_text_atomically(
            json.dumps(as_document(rows), indent=2, allow_nan=False) + "\n", folder / EVALUATION
        )
        document: dict[str, Any] = {"words": options.worlds, **asked}
        if options.noise is not None:
            document["noise"] = asdict(options.noise)
        if isinstance(policy, Policy):
            file = options.path / files.POLICY if options.path.is_dir() else options.path
            document |= {"card": policy.card, "sha256": files.digest(file)}
        else:
            document |= {"policy": options.policy, "memory": options.memory}
        write_text_atomically(json.dumps(document, indent=2) + "\n", folder / files.SETTINGS)
    print(f"\n{name_of(options)}\n{printed(summary)}")
    print(f"written: {folder}")
    return summary


if __name__ == "__main__":
    main()
