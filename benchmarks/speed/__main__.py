"""Run the benchmarks: print one table, write one file.

    python -m benchmarks.speed                 all of them, a few minutes
    python -m benchmarks.speed --quick         all of them, with fewer and shorter rounds
    python -m benchmarks.speed --only start    one of them
    python -m benchmarks.speed --check         exit with status 1 if a ratio is above its target

The file, ``benchmarks/speed/latest.json``, holds what this run measured: a list of objects with
``name``, ``value``, ``unit``, ``ratio`` and ``baseline``. A ratio is this package's time over
TorchRL's, both from this run; times alone say more about the machine than about the code.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from benchmarks.speed import (
    environment,
    method_steps,
    replay,
    replay_peers,
    start,
    training,
    updates,
    vector,
    worlds,
)
from benchmarks.speed.timing import Entry
from torchrl_mpfa.saving import write_text_atomically

LATEST = Path(__file__).with_name("latest.json")

TARGETS: Mapping[str, float] = {
    "sample_update_1e5": 0.50,
    "sample_update_1e6": 0.50,
    "sample_16x256": 0.60,
    "replay_1e5": 0.50,
    "replay_1e6": 0.50,
    "iteration_4x256": 0.50,
    "extend_one": 0.30,
    "extend_16": 0.30,
    "train_step": 0.90,
    "sb3_step": 0.90,
    "update_ddpg_64": 1.25,
    "update_ddpg_256": 1.00,
    "update_td3_64": 1.25,
    "update_td3_256": 1.00,
    "loop_ddpg_64": 1.00,
    "import_package": 1.10,
    "train_help": 1.30,
}
"""Highest ratio that each entry may have."""


def measure_environment(*, quick: bool) -> list[Entry]:
    """Measure the navigation task, a fifth as long if quick; ratios are of rates."""
    return environment.measure(seconds=0.2 if quick else 1.0)


def measure_sample_update_1e6(*, quick: bool) -> list[Entry]:
    """Measure as at 1e5, with ten times the slots."""
    return replay.measure_sample_update("sample_update_1e6", capacity=1_000_000, quick=quick)


BENCHMARKS: Mapping[str, Callable[..., list[Entry]]] = {
    "sample_update_1e5": replay.measure_sample_update,
    "sample_update_1e6": measure_sample_update_1e6,
    "sample_16x256": replay.measure_sample_16x256,
    "iteration_4x256": replay.measure_iteration_4x256,
    "replay_1e5": replay_peers.measure,
    "replay_1e6": partial(replay_peers.measure, "replay_1e6", capacity=1_000_000),
    "extend_one": replay.measure_extend_one,
    "extend_16": replay.measure_extend_16,
    "train_step": training.measure_train_step,
    "sb3_step": training.measure_sb3_step,
    **{name: partial(updates.measure, name) for name in updates.CASES},
    "methods": method_steps.measure,
    "environment": measure_environment,
    "vector": vector.measure,
    "worlds": worlds.measure,
    "start": start.measure,
    "runs": start.measure_runs,
}


def format_table(entries: Sequence[Entry]) -> str:
    """One line an entry, with the target next to the ratios that have one."""
    width = max((len(entry["name"]) for entry in entries), default=4) + 2
    lines = [f"{'name':{width}}{'value':>12} {'unit':9}{'ratio':>8}{'target':>8}  baseline"]
    for entry in entries:
        ratio = "" if entry["ratio"] is None else f"{entry['ratio']:.2f}"
        target = f"{TARGETS[entry['name']]:.2f}" if entry["name"] in TARGETS else ""
        line = f"{entry['name']:{width}}{entry['value']:12.5g} {entry['unit']:9}{ratio:>8}"
        lines.append(f"{line}{target:>8}  {entry['baseline'] or ''}".rstrip())
    return "\n".join(lines)


def missed_targets(entries: Sequence[Entry]) -> list[str]:
    """A sentence for each entry whose ratio is above its target."""
    return [
        f"{entry['name']}: ratio {entry['ratio']:.2f} is above its target {TARGETS[entry['name']]}"
        for entry in entries
        if entry["ratio"] is not None and entry["ratio"] > TARGETS.get(entry["name"], float("inf"))
    ]


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="fewer and shorter rounds")
    parser.add_argument(
        "--only", choices=list(BENCHMARKS), metavar="NAME", help=f"one of {', '.join(BENCHMARKS)}"
    )
    parser.add_argument("--check", action="store_true", help="exit with 1 if a target is missed")
    parser.add_argument("--output", type=Path, default=LATEST, help="file (default: %(default)s)")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, write; return the exit status."""
    options = parse(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    entries: list[Entry] = []
    for name in [options.only] if options.only else BENCHMARKS:
        print(f"measuring {name}", file=sys.stderr, flush=True)
        entries += BENCHMARKS[name](quick=options.quick)
    print(f"\n{format_table(entries)}")
    write_text_atomically(json.dumps(entries, indent=2) + "\n", options.output)
    print(f"\nwritten: {options.output}")
    missed = missed_targets(entries) if options.check else []
    for sentence in missed:
        print(sentence, file=sys.stderr)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
