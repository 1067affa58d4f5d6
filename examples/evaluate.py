"""Evaluate a trained policy between fixed starts and goals in one or several worlds.

    python examples/evaluate.py runs/demo --worlds A --episodes 100
    python examples/evaluate.py runs/demo --worlds test rooms:100-109 --episodes 40
    python examples/evaluate.py examples/policies/td3-mpfa_per.npz    comes with the project

Prints a row for each world and their total. Writes to the folder ``evaluation-WORLDS`` in that of
the run, for another file to runs/evaluation-NAME, or to --output: summary.csv (the rows with their
intervals), episodes.csv (a row an episode), settings.json (what was asked for, and the policy's
card), and for each world trajectories-WORLD.png (every way) and episode-WORLD.gif (one from above).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from PIL import Image

from mpfa_envs import EpisodeResult, Policy, load_policy, render_trajectories
from navigation import files
from navigation.evaluating import Drives, drive, film, summary_row
from navigation.figures import write_animation
from navigation.records import as_table, write_table
from navigation.stopping import end_with_parent
from navigation.worlds import parse_worlds, world_name, worlds_label
from torchrl_mpfa.saving import write_text_atomically

_COLUMNS = {"success": "{:.1%}", "collision": "{:.1%}", "timeout": "{:.1%}", "spl": "{:.3f}"}
_SECONDS = {"time_s": "{:.1f}", "min_clearance": "{:.3f}"}


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policy", type=Path, help="policy.npz, or the folder of a run")
    parser.add_argument(
        "--worlds",
        nargs="+",
        default=["test"],
        help="names, world files, and spans of generated worlds such as rooms:100-109",
    )
    parser.add_argument("--episodes", type=int, default=200, help="in each world (default: 200)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the pairs (default: 0)")
    parser.add_argument("--output", type=Path, help="folder (default: in that of the run)")
    parser.add_argument("--physics", choices=["wheels", "kinematic"], help="default: as trained")
    parser.add_argument("--no-pictures", action="store_true", help="write tables alone")
    options = parser.parse_args(arguments)
    for name, least in (("episodes", 1), ("seed", 0)):
        if getattr(options, name) < least:
            parser.error(f"--{name} must be at least {least}, got {getattr(options, name)}")
    try:
        options.names = parse_worlds(options.worlds)
        options.loaded = load_policy(options.policy)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    return options


def output_folder(policy: Path, words: Sequence[str]) -> Path:
    """Where results go unless the command line says: each choice of worlds has its own folder."""
    name = f"evaluation-{worlds_label(words)}"
    if policy.is_dir():
        return policy / name
    if policy.name == files.POLICY:
        return policy.parent / name
    return Path("runs") / f"evaluation-{policy.stem}" / name


def printed(summary: pd.DataFrame) -> str:
    """The table on the screen: estimates, and the interval of success."""
    table = summary[["world", "episodes"]].copy()
    for name, form in {**_COLUMNS, **_SECONDS}.items():
        table[name] = summary[name].map(form.format)
    ends = zip(summary["success_low"], summary["success_high"], strict=True)
    table.insert(3, "95 %", [f"[{low:.1%}, {high:.1%}]" for low, high in ends])
    return table.to_string(index=False)


def write_pictures(
    policy: Policy, world: str, drives: Drives, options: argparse.Namespace, folder: Path
) -> None:
    """Every way in one picture, and one episode as an animation."""
    results, name = drives.results, world_name(world)
    ends = ["success" if r.success else "collision" if r.collision else "timeout" for r in results]
    picture = render_trajectories(
        world,
        drives.trails,
        drives.goals,
        ends,  # type: ignore[arg-type]
        title=f"world {name}",
        size=640,
    )
    Image.fromarray(picture).save(folder / f"trajectories-{name}.png")
    # The success with the longest way shows most; any episode if there is none.
    shown = max([r for r in results if r.success] or results, key=lambda r: r.path_length)
    frames = film(policy, world, episode=shown.episode, seed=options.seed, physics=options.physics)
    write_animation(frames, folder / f"episode-{name}.gif")


def main(arguments: Sequence[str] | None = None) -> pd.DataFrame:
    """Evaluate, print, write.

    Args:
        arguments: The command line.

    Returns:
        A row for each world, and the total.
    """
    end_with_parent()
    options = parse(arguments)
    policy: Policy = options.loaded
    folder = options.output or output_folder(options.policy, options.worlds)
    asked = {"episodes": options.episodes, "seed": options.seed, "physics": options.physics}
    results: list[EpisodeResult] = []
    rows = []
    with files.lock(folder):
        for world in options.names:
            drives = drive(policy, world, progress=not options.no_pictures, **asked)
            results += drives.results
            rows.append({"world": world_name(world), **summary_row(drives.results)})
            if not options.no_pictures:
                write_pictures(policy, world, drives, options, folder)
        if len(rows) > 1:
            rows.append({"world": "total", **summary_row(results)})
        summary = pd.DataFrame(rows)
        write_table(summary, folder / "summary.csv")
        write_table(as_table(results, EpisodeResult), folder / files.EPISODES)
        document = {"words": options.worlds, **asked, "card": policy.card}
        write_text_atomically(json.dumps(document, indent=2) + "\n", folder / files.SETTINGS)
    print(f"\n{options.policy}, {options.episodes} pairs in each world\n{printed(summary)}")
    print(f"written: {folder}")
    return summary


if __name__ == "__main__":
    main()
