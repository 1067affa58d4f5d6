"""Evaluate a policy or a planner between fixed starts and goals, in given or generated worlds.

    python examples/evaluate.py runs/demo --worlds A --episodes 100
    python examples/evaluate.py runs/demo --worlds test rooms:100-109 bars:test barn
    python examples/evaluate.py runs/demo --worlds all        all test worlds without walkers
    python examples/evaluate.py td3-rooms                 a policy that comes with the package
    python examples/evaluate.py --policy dwa --worlds bars:validation    a planner
    python examples/evaluate.py td3-rooms --robot turtlebot4    on another robot than its own
    python examples/evaluate.py runs/demo --worlds mazes:test --live     in a window, not kept
    python examples/evaluate.py td3-rooms --team 4 --worlds crossing     four robots in one world

Prints one row per world or generator, and the total. Writes to --output; by default to
``evaluation-WORLDS-PHYSICS`` in the folder of the run, or, for other files and planners, in
runs/evaluation-NAME; another seed, robot and noise are part of that name:
summary.csv (the rows with their intervals), evaluation.json (their numbers), episodes.csv (one row
per episode), settings.json (the arguments, and a policy's card), trajectories.png (paths in up to
nine worlds, at most twenty in each), episode.gif (the longest one from above, with the speeds of
the wheels) and, for a policy, values.png (its actions over the whole room). The last two show Q if
path is the folder of a run, whose checkpoint has the critic.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import training.extra  # noqa: F401

# isort: split
from mpfa_envs import (
    GENERATORS,
    PLANNERS,
    POLICIES,
    Policy,
    RobotNoise,
    TaskConfig,
    load_policy,
    make_planner,
)
from mpfa_envs.policies.policy import policy_file
from mpfa_envs.robots.resolve import resolve_robot
from mpfa_envs.tasks.teams import TEAM_WORLDS
from training import files
from training.evaluating import (
    Conditions,
    Drivable,
    check_physics,
    drive,
    filtered,
    needs_filter,
    on_robot,
    summary_row,
    tasks_of,
)
from training.finished import warnings_of
from training.options import add_filter, add_plugin, add_robot, check_least
from training.teams import add_team, drive_teams, team_worlds
from training.teams import printed as printed_teams
from training.worlds import parse_worlds, understood, world_name

if TYPE_CHECKING:
    import pandas as pd

    from training.pictures import Values

EVALUATION = "evaluation.json"
_DOCUMENTED = (
    *("success", "collision", "timeout", "standstill", "spl", "sct", "time_s"),
    *("path_length", "plan_s", "decision_s", "barn_score"),
)
"""Columns that are in the file, too."""
_FORMATS = {
    **dict.fromkeys(("success", "collision", "timeout", "standstill"), "{:.1%}"),
    **dict.fromkeys(("spl", "sct", "barn_score"), "{:.3f}"),
    **{"time_s": "{:.1f}", "path_length": "{:.2f}", "min_clearance": "{:.3f}"},
    **{"plan_ms": "{:.2f}", "decision_ms": "{:.2f}"},
    **{"walker_distance": "{:.3f}", "intrusion_time": "{:.1f}", "time_to_collision": "{:.2f}"},
}
"""Columns on the screen; a summary has those of BARN or of walkers where they are."""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "path",
        type=Path,
        nargs="?",
        help=f"policy.npz, the folder of a run, or {', '.join(POLICIES)}",
    )
    parser.add_argument(
        "--policy",
        choices=list(PLANNERS),
        help="a planner instead: "
        + "; ".join(f"{name}, {what}" for name, what in PLANNERS.items()),
    )
    parser.add_argument(
        "--memory", choices=["none", "map"], default="none", help="map: dwa has a map of its own"
    )
    add_robot(parser, "that of the policy; turtlebot2 for planners")
    parser.add_argument(
        "--worlds",
        nargs="+",
        help="names, world files, spans (rooms:100-109), splits (bars:test), barn, barn:PATH "
        "of its archive, or all (default: test)",
    )
    parser.add_argument(
        "--episodes", type=int, help="for each (default: 200 in a world, 400 for a generator)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of pairs and ants (default: 0)")
    parser.add_argument("--output", type=Path, help="folder (default: in the folder of the run)")
    parser.add_argument(
        "--physics",
        choices=["wheels", "kinematic"],
        help="default: as trained; kinematic for planners",
    )
    parser.add_argument(
        "--noise",
        type=read_noise,
        metavar="NAME=VALUE,...",
        help="errors of the robot: range_noise, dropout, slip, drift (default: none)",
    )
    parser.add_argument(
        "--latency",
        type=float,
        metavar="SECONDS",
        help="time from a scan to the moment at which the wheels take the order (default: the "
        "robot's)",
    )
    add_filter(parser)
    parser.add_argument(
        "--approach",
        type=float,
        default=0.0,
        metavar="SPEED",
        help="the filter has the robot stand before what comes at this speed [m/s] (default: 0)",
    )
    parser.add_argument(
        "--rescue",
        action="store_true",
        help="predictive control leads a robot on that stands still again, as a Pilot does",
    )
    parser.add_argument(
        "--plan",
        choices=["unknown", "known"],
        help="known: the robot's map begins with the world's walls (default: as in training)",
    )
    parser.add_argument(
        "--goal-radius", type=float, help="distance that reaches the goal [m] (default: likewise)"
    )
    add_team(parser)
    add_plugin(parser)
    parser.add_argument(
        "--live", action="store_true", help="watch the episodes in a window; write nothing"
    )
    parser.add_argument("--no-pictures", action="store_true", help="write only tables")
    options = parser.parse_args(arguments)
    check_least(parser, options, episodes=1, seed=0, team=1)
    if (options.path is None) == (options.policy is None):
        parser.error("give either the path of a trained policy or --policy with a planner")
    if options.memory != "none" and options.policy != "dwa":
        parser.error(f"--memory {options.memory} is for --policy dwa alone: mpc has a map")
    try:
        options.robot = options.robot and resolve_robot(options.robot)
        teams = options.team > 1
        if options.right_of_way and not teams:
            raise ValueError("--right-of-way must come with --team, got a team of 1")
        options.worlds = options.worlds or (list(TEAM_WORLDS) if teams else ["test"])
        options.names = team_worlds(options) if teams else parse_worlds(options.worlds)
        options.loaded = load_driver(options)
        if options.filter is None:
            options.filter = bool(options.approach) or needs_filter(options.loaded)
        if options.approach and not options.filter:
            raise ValueError(f"--approach must be 0 with --no-filter, got {options.approach}")
        if options.rescue and not options.filter:
            raise ValueError("--rescue must come with --filter, got none")
        options.asked = conditions(options)
        check_physics(options.asked.physics)
        task = TaskConfig(**options.loaded.env_arguments | options.asked.arguments)
        if options.filter:
            task.make_filter(approach=options.approach)
        if options.rescue and task.memory != "map":
            raise ValueError("--rescue must come with a map, got memory='none'")
        files.check_folder(options.output or output_folder(options))
    except (ValueError, OSError) as error:
        parser.error(str(error))
    return options


def conditions(options: argparse.Namespace) -> Conditions:
    """The conditions of the evaluation that the command line asks for."""
    task = {name: getattr(options, name) for name in ("plan", "goal_radius")}
    return Conditions(
        tuple(options.worlds),
        options.physics or options.loaded.env_arguments.get("physics", "wheels"),
        options.episodes,
        options.seed,
        options.noise,
        options.latency,
        options.filter,
        options.approach,
        options.robot,
        {name: value for name, value in task.items() if value is not None},
        options.team,
        options.right_of_way,
        options.rescue,
    )


def read_noise(words: str) -> RobotNoise:
    """Parse ``--noise slip=0.1,drift=0.02``."""
    try:
        values = {
            name: float(value) for name, _, value in (w.partition("=") for w in words.split(","))
        }
        return RobotNoise(**values)
    except (TypeError, ValueError) as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def load_driver(options: argparse.Namespace) -> Drivable:
    """The policy or the planner that the command line names."""
    if options.policy is None:
        return on_robot(load_policy(options.path), options.robot)
    robot = options.robot or "turtlebot2"
    return make_planner(options.policy, robot=robot, memory=options.memory, seed=options.seed)


def name_of(options: argparse.Namespace) -> str:
    """Return the name of what is evaluated: the path of a policy, or a planner's name."""
    parts = [options.policy or str(options.path)]
    parts.append(options.memory if options.memory != "none" else "")
    parts.append(options.robot.name if options.robot else "")
    return "-".join(part for part in parts if part)


def output_folder(options: argparse.Namespace) -> Path:
    """Return the default folder of the results."""
    policy, name = options.path, options.asked.folder
    if policy is None:
        # The robot of a planner is in the planner's name.
        name = replace(options.asked, robot=None).folder
        return Path("runs") / files.short_name(f"evaluation-{name_of(options)}") / name
    if policy.is_dir():
        return policy / name
    if policy.name == files.POLICY:
        return policy.parent / name
    return Path("runs") / files.short_name(f"evaluation-{policy.stem}") / name


def printed(summary: pd.DataFrame) -> str:
    """The table on the screen: estimates, and the interval of success."""
    table = summary[["world", "episodes"]].copy()
    shown = summary.assign(plan_ms=1e3 * summary["plan_s"], decision_ms=1e3 * summary["decision_s"])
    for name, form in _FORMATS.items():
        if name in shown:
            table[name] = shown[name].map(form.format).where(shown[name].notna(), "")
    ends = zip(summary["success_low"], summary["success_high"], strict=True)
    table.insert(3, "95 %", [f"[{low:.1%}, {high:.1%}]" for low, high in ends])
    return table.to_string(index=False)


def as_document(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the rows as one document: the total, and each generator and world by name."""

    def entries(row: Mapping[str, Any]) -> dict[str, Any]:
        # JSON has no NaN, which the time is where no episode succeeds.
        values = ((name, float(row[name])) for name in _DOCUMENTED if name in row)
        kept = {name: None if math.isnan(value) else value for name, value in values}
        return {"episodes": int(row["episodes"]), **kept}

    document: dict[str, Any] = {
        "physics": rows[-1]["physics"],
        **entries(rows[-1]),
        "generators": {},
        "worlds": {},
    }
    for row in rows:
        generator, _, split = str(row["world"]).partition("-")
        if generator in GENERATORS and split in ("test", "validation"):
            # Other than test worlds are named, lest both of a generator have one name.
            name = generator if split == "test" else f"{generator}:{split}"
            document["generators"][name] = entries(row)
        elif row["world"] != "total":
            document["worlds"][row["world"]] = entries(row)
    return document


def critic(options: argparse.Namespace) -> Values | None:
    """Return the values of the critic of a run, if there is a run."""
    if options.path is None or not (options.path / files.CHECKPOINT).exists():
        return None
    from training.run.checkpoints import load_learner
    from training.run.evaluations import values_of

    try:
        learner, settings = load_learner(options.path, options.loaded)
    except ValueError as error:
        print(f"no picture of Q: {error}")
        return None
    return values_of(learner, options.loaded, settings)


def show_live(driver: Drivable, options: argparse.Namespace) -> pd.DataFrame:
    """Show the episodes in a window, one after another; return how each ended."""
    import pandas as pd

    from training.pictures import watch

    rows = []
    tasks = tasks_of(driver, options.names, episodes=options.episodes, seed=options.seed)
    for end in watch(driver, tasks, **options.asked.arguments):
        print(f"{end.world}: {end.outcome} after {end.time_s:.1f} s")
        rows.append(end._asdict())
    return pd.DataFrame(rows)


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold the folder of the results; exit if another process holds it."""
    try:
        with files.lock(folder):
            yield
    except files.FolderInUse as error:
        print(f"evaluate.py: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def logged(policy: Policy, run: Path, folder: Path, summary: pd.DataFrame) -> Iterator[str]:
    """Log the evaluation to the wandb run of the training; yield lines that say so."""
    from training.pictures import TRAJECTORIES
    from training.run.tracking import log_evaluation

    name, steps = folder.name.removeprefix("evaluation-"), policy.card.get("steps", 0)
    try:
        found = log_evaluation(run, name, summary, actions=steps, picture=folder / TRAJECTORIES)
    except ValueError as error:
        yield f"not in wandb: {error}"
    else:
        if found:
            yield f"in wandb, too: {found}"


def described(options: argparse.Namespace) -> dict[str, Any]:
    """What an evaluation was of, for the file of its settings."""
    if isinstance(policy := options.loaded, Policy):
        driver = {"card": policy.card, "sha256": files.digest(policy_file(options.path))}
    else:
        driver = {"policy": options.policy, "memory": options.memory}
    return options.asked.as_json() | driver


def main(arguments: Sequence[str] | None = None) -> pd.DataFrame:
    """Evaluate, print, write.

    Args:
        arguments: The command line.

    Returns:
        A row for each world, and the total.
    """
    options = parse(arguments)
    # Imported here as they take seconds: what is misspelt is answered before.
    import pandas as pd

    from mpfa_envs.evaluation.results import EpisodeResult
    from torchrl_mpfa.saving import write_text_atomically
    from training.pictures import write_pictures
    from training.records import as_table, write_table

    policy = options.loaded
    asked: Conditions = options.asked
    if asked.team == 1:
        print(understood(policy.env_arguments.get("robot", "turtlebot2"), options.worlds))
    if options.path is not None and options.path.is_dir():
        for sentence in warnings_of(options.path):
            print(f"warning: {sentence}")
    driver: Drivable = policy
    if asked.filtered:
        driver = filtered(policy, approach=asked.approach, rescue=asked.rescue, **asked.arguments)
    folder = options.output or output_folder(options)
    if options.live:
        return show_live(driver, options)
    settings = json.dumps(described(options), indent=2) + "\n"
    if asked.team > 1:
        with held(folder):
            summary = drive_teams(
                driver, asked, options.names, folder, pictures=not options.no_pictures
            )
            write_text_atomically(settings, folder / files.SETTINGS)
        print(f"\n{name_of(options)}, physics: {asked.physics}\n{printed_teams(summary)}")
        print(f"written: {folder}")
        return summary
    with held(folder):
        driven = drive(
            driver,
            options.names,
            episodes=asked.episodes,
            seed=asked.seed,
            progress=not options.no_pictures,
            **asked.arguments,
        )
        results = [result for drives in driven for result in drives.results]
        rows = [
            {"world": world_name(world), "physics": asked.physics, **summary_row(drives.results)}
            for world, drives in zip(options.names, driven, strict=True)
        ]
        if not options.no_pictures:
            print("drawing the paths and the longest drive", file=sys.stderr)
            write_pictures(driver, driven, folder, values=critic(options), **asked.arguments)
        if len(rows) > 1:
            rows.append({"world": "total", "physics": asked.physics, **summary_row(results)})
        summary = pd.DataFrame(rows)
        write_table(summary, folder / "summary.csv")
        episodes = as_table(results, EpisodeResult)
        episodes.insert(0, "physics", asked.physics)
        write_table(episodes, folder / files.EPISODES)
        write_text_atomically(
            json.dumps(as_document(rows), indent=2, allow_nan=False) + "\n", folder / EVALUATION
        )
        write_text_atomically(settings, folder / files.SETTINGS)
    print(f"\n{name_of(options)}, physics: {asked.physics}\n{printed(summary)}")
    print(f"written: {folder}")
    if isinstance(policy, Policy) and options.path.is_dir():
        for line in logged(policy, options.path, folder, summary):
            print(line)
    return summary


if __name__ == "__main__":
    files.run_script(main)
