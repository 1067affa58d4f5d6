"""Drive the policies of a study through random rooms, to see how they do on more than one map.

    python examples/rooms.py runs/compare                      rooms 100 to 109, 40 pairs each
    python examples/rooms.py runs/compare --rooms 7 8 --pairs 10

Every finished run in the folder (LEARNER-METHOD-SEED) drives greedily between the same fixed pairs
of start and goal, collision at contact. Writes rooms.csv there, a row per episode, which
``report.py`` makes a table of.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from compare import DONE, RESULT_FIELDS, drive
from mpfa_envs import random_world
from records import write_rows

ROOMS = range(100, 110)
"""None of them was looked at when a setting was chosen; docs/tuning.md has those that were."""
FILE = "rooms.csv"
COLUMNS = ["learner", "method", "seed", "world", *RESULT_FIELDS]


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the folder of a study")
    parser.add_argument("--rooms", nargs="+", type=int, default=list(ROOMS), help="their seeds")
    parser.add_argument("--pairs", type=int, default=40, help="in each room (default: 40)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default: 2)")
    options = parser.parse_args(arguments)
    for name in ("pairs", "jobs"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(options, name)}")
    for seed in options.rooms:
        try:
            random_world(seed)
        except ValueError as error:
            parser.error(f"--rooms: {error}")
    return options


def runs_of(folder: Path) -> list[tuple[Path, dict[str, str]]]:
    """Finished runs in the folder of a study, and what their names say."""
    found = []
    for path in sorted(folder.glob(f"*/{DONE}")):
        name = re.fullmatch(r"([^-]+)-([^-]+)-(\d+)", path.parent.name)
        if name:
            learner, method, seed = name.groups()
            found.append((path.parent, {"learner": learner, "method": method, "seed": seed}))
    return found


def drive_room(task: tuple[Path, dict[str, str], str, int]) -> list[dict[str, Any]]:
    """Rows of one policy in one room."""
    path, which, world, pairs = task
    torch.set_num_threads(1)
    results = drive(path, world=world, episodes=pairs)
    return [{**which, "world": world, **asdict(result)} for result in results]


def main(arguments: Sequence[str] | None = None) -> int:
    """Drive every policy in every room, and keep every episode.

    Args:
        arguments: The command line.

    Returns:
        Exit status.
    """
    options = parse(arguments)
    runs = runs_of(options.folder)
    if not runs:
        print(f"{options.folder} has no LEARNER-METHOD-SEED/{DONE}, a finished run of compare.py")
        return 1
    tasks = [
        (path, which, f"random-{seed}", options.pairs)
        for path, which in runs
        for seed in options.rooms
    ]
    # Spawned, as forking a process in which PyTorch has threads may leave locks held.
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        answers = tqdm(pool.map(drive_room, tasks), total=len(tasks), unit="room")
        rows = [row for answer in answers for row in answer]
    write_rows(rows, COLUMNS, options.folder / FILE)
    print(f"written: {options.folder / FILE}; now: report.py {options.folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
