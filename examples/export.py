"""Write a trained policy as an ONNX file with a JSON card, for robots and other tools.

    python examples/export.py runs/demo                             writes runs/demo/policy.onnx
    python examples/export.py td3-rooms                 a policy that comes with the package
    python examples/export.py runs/demo --quantize --output small.onnx    eight-bit weights
    python examples/export.py td3-rooms --robot cart.yaml    for another robot than it learned on

The card, ``policy.json``, says what the policy senses and in which units, what its robot may do,
how it was trained, how well it performs (the evaluations in the run's folder) and which file it
belongs to. The file is compared with the policy on a thousand observations and on the same tasks;
the result is printed and added to the card.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mpfa_envs import POLICIES, Policy, evaluate, export_policy, load_policy, world_tasks
from mpfa_envs.policies.policy import policy_file
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.robots.resolve import resolve_robot
from training import files
from training.evaluating import Drivable, filtered, needs_filter, on_robot
from training.options import add_filter, add_robot, check_least

TOLERANCE = 1e-6
"""By how much actions of the file may differ, unless it is quantized."""
_OBSERVATIONS = 1000
_LIKELY = (-1.0, 1.0)
"""Range in which most numbers of an observation lie."""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "path", type=Path, help=f"policy.npz, the folder of a run, or {', '.join(POLICIES)}"
    )
    parser.add_argument("--output", type=Path, help="the file (default: NAME.onnx next to it)")
    parser.add_argument("--quantize", action="store_true", help="round weights to eight bits")
    add_robot(parser, "that of the policy")
    parser.add_argument("--world", default="test", help="where both drive (default: test)")
    add_filter(parser)
    parser.add_argument(
        "--episodes", type=int, default=100, help="tasks that both drive; 0: none (default: 100)"
    )
    options = parser.parse_args(arguments)
    check_least(parser, options, episodes=0)
    try:
        options.robot = options.robot and resolve_robot(options.robot)
        options.policy = on_robot(load_policy(options.path), options.robot)
        if options.filter is None:
            options.filter = needs_filter(options.policy)
        if options.filter:
            filtered(options.policy)
        world_tasks(options.world, episodes=1)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    options.source = policy_file(options.path)
    # One of the package is written where the command is called.
    beside = options.source if options.path.exists() else Path(options.source.name)
    options.output = options.output or beside.with_suffix(".onnx")
    if options.output.suffix != ".onnx":
        parser.error(f"--output must end in .onnx, got {options.output}")
    try:
        files.check_folder(options.output.parent)
        files.check_name(_trial(options.output))
    except ValueError as error:
        parser.error(f"--output: {error}")
    if options.output.is_dir():
        parser.error(f"--output must be a file, got the folder {options.output}")
    if not options.policy.layers:
        parser.error(f"{options.path} is an ONNX file: export the policy.npz that it came from")
    return options


def _trial(output: Path) -> Path:
    """Path of a file until it is known to do as the policy does."""
    return output.with_name(f".{os.getpid()}.{output.name}")


def known_results(source: Path, robot: RobotModel | None) -> list[dict[str, Any]]:
    """The evaluations in the folder of a policy that are of this very file on this robot."""
    fields = None if robot is None else json.loads(json.dumps(asdict(robot)))
    found = []
    for file in sorted(source.parent.glob("evaluation*/evaluation.json")):
        settings = file.parent / files.SETTINGS
        if settings.is_file():
            asked = json.loads(settings.read_text(encoding="utf-8"))
            if (asked.get("sha256"), asked.get("robot")) == (files.digest(source), fields):
                numbers = json.loads(file.read_text(encoding="utf-8"))
                how = {"physics": asked["physics"], "filter": "filter" in asked}
                found.append({"worlds_asked": asked["words"], **how, **numbers})
    return found


def largest_difference(one: Policy, other: Policy) -> float:
    """By how much the actions of two policies differ at most, of a thousand observations."""
    shape = (_OBSERVATIONS, one.observation_size)
    seen = np.random.default_rng(0).uniform(*_LIKELY, shape).astype(np.float32)
    return float(np.abs(one(seen) - other(seen)).max())


def driven(policy: Policy, options: argparse.Namespace) -> dict[str, Any]:
    """Drive a policy through the tasks, on exact arcs."""
    driver: Drivable = filtered(policy) if options.filter else policy
    results = evaluate(driver, options.world, episodes=options.episodes, physics="kinematic")
    rates = {
        name: sum(getattr(each, name) for each in results) / len(results)
        for name in ("success", "collision", "timeout")
    }
    return {"results": results, **rates}


def main(arguments: Sequence[str] | None = None) -> Path:
    """Export, compare and report.

    Args:
        arguments: The command line.

    Returns:
        The file.
    """
    options = parse(arguments)
    policy: Policy = options.policy
    results = known_results(options.source, options.robot)
    # Next to its place at first: a file that differs from its policy must not lie there.
    trial = _trial(options.output)
    try:
        export_policy(policy, trial, quantize=options.quantize)
        exported = load_policy(trial)
    finally:
        for file in (trial, trial.with_suffix(".json")):
            file.unlink(missing_ok=True)
    difference = largest_difference(policy, exported)
    print(f"largest difference of an action, {_OBSERVATIONS} observations: {difference:.2g}")
    if difference > TOLERANCE and not options.quantize:
        raise SystemExit(f"the file differs from the policy by {difference}: not written")
    if options.episodes:
        both = {"policy": driven(policy, options), "file": driven(exported, options)}
        how = "behind the filter" if options.filter else "without the filter"
        for name, rates in both.items():
            shown = ", ".join(
                f"{key} {rates[key]:.1%}" for key in ("success", "collision", "timeout")
            )
            print(f"{name:6} {options.episodes} tasks in {options.world}, {how}: {shown}")
        same = [
            a == b for a, b in zip(*(each.pop("results") for each in both.values()), strict=True)
        ]
        print(f"the same to the last digit: {sum(same)} of {len(same)}")
        results.append(
            {
                "exported": both["file"],
                "before": both["policy"],
                "world": options.world,
                "episodes": options.episodes,
                "physics": "kinematic",
                "filter": options.filter,
                "same": sum(same),
            }
        )
    export_policy(policy, options.output, quantize=options.quantize, results=results)
    print(f"written: {options.output} ({options.output.stat().st_size} bytes) and its card")
    return Path(options.output)


if __name__ == "__main__":
    files.run_script(main)
