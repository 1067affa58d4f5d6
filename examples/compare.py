"""Train several methods with several seeds, evaluate each run's policy, keep every episode.

    python examples/compare.py                             three methods, three seeds, two at a time
    python examples/compare.py --learners ddpg td3         two learners, 18 runs
    python examples/compare.py --worlds test mazes:test --episodes 40    a world and a generator's
    python examples/compare.py --physics wheels --no-filter    evaluated on wheels, no filter
    python examples/compare.py --arm default: --arm phi2:method.boost_factor=2    two arms of each
    python examples/compare.py --folder runs/paper -- regime=paper    the paper's task
    python examples/compare.py --plugin mine.py --methods mine per    a method of your own
    python examples/compare.py --ray HEAD:6379            on all machines of a Ray cluster

A run of the default 30,000 actions, with its evaluation, takes some one and a half minutes of a
core: on two cores the first line takes some eight minutes, the second a quarter of an hour. Each of
the --jobs processes makes one run after another, with the numbers of train.py and evaluate.py alone
and without the ten seconds or more that a process takes to start.

What follows ``--`` goes to ``train.py``; an arm adds settings of its own, for every learner, method
and seed. It can be stopped at any moment and continued by the same command: finished runs are left
alone, others resume from their last checkpoint, also if their process was killed or their machine
was lost (``docs/scaling.md`` has the requirements of ``--ray``). A run that was trained with other
settings is an error, or with ``--anew`` is trained again. ``report.py`` makes tables and figures
from the folder. Its files:

    LEARNER-METHOD-SEED/   a run of train.py, with the output of evaluate.py; with arms
                           LEARNER-METHOD-ARM-SEED/
    episodes.csv           every evaluation episode of every run
    settings.json          what was evaluated, and the settings of the runs
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import training.extra  # noqa: F401

# isort: split
from training import files
from training.options import EPISODES, WORLDS, add_options, add_plugin, check_least
from training.plugins import with_plugin


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default, kind, text in (
        ("methods", ["mpfa_per", "per", "uniform"], str, "as in train.py method=NAME"),
        ("learners", ["ddpg"], str, "as in train.py learner=NAME"),
        ("seeds", [0, 1, 2], int, "one run of each method with each of them"),
    ):
        shown = " ".join(map(str, default))
        parser.add_argument(
            f"--{name}", nargs="+", type=kind, default=default, help=f"{text} (default: {shown})"
        )
    add_options(parser, folder="runs/compare", what="runs")
    parser.add_argument("--worlds", nargs="+", default=WORLDS, help="(default: test)")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="for each (default: 200)")
    parser.add_argument("--physics", choices=["wheels", "kinematic"], help="default: as trained")
    parser.add_argument(
        "--filter",
        action=argparse.BooleanOptionalAction,
        help="evaluate behind the filter (default: policies that had it in all of their training)",
    )
    parser.add_argument(
        "--arm",
        action="append",
        default=[],
        metavar="NAME:SETTING=VALUE,...",
        help="a name and its settings, added to every run; may be given several times",
    )
    add_plugin(parser)
    parser.add_argument("--anew", action="store_true", help="train runs with other settings again")
    parser.add_argument("overrides", nargs="*", help="settings of train.py, after --")
    options = parser.parse_args(arguments)
    # Imported here, and below, as they take seconds: what is misspelt is answered before.
    from training.comparison.arms import check_free, parse_arms

    try:
        options.overrides, options.plugin = with_plugin(options.overrides, options.plugin)
        check_free(options.overrides)
        options.arms = parse_arms(options.arm)
        files.check_folder(options.folder)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    from torchrl_mpfa.checks import unknown
    from torchrl_mpfa.methods.catalogue import unknown_method
    from training.settings.train import GROUPS

    for group in ("method", "learner", "seed"):
        names = getattr(options, f"{group}s")
        for number, name in enumerate(names):
            if group in GROUPS and name not in GROUPS[group]:
                is_method = group == "method"
                parser.error(
                    unknown_method(name) if is_method else unknown(group, name, GROUPS[group])
                )
            if name in names[:number]:
                parser.error(f"--{group}s has {name} twice")
    check_least(parser, options, jobs=1, episodes=1)
    from training.evaluating import check_physics
    from training.worlds import parse_worlds

    try:
        check_physics(options.physics or "kinematic")
    except ValueError as error:
        parser.error(str(error))
    try:
        parse_worlds(options.worlds)
    except (ValueError, OSError) as error:
        parser.error(f"--worlds: {error}")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Train what is not trained, evaluate it, collect the rows.

    Args:
        arguments: The command line.

    Returns:
        Exit status: 1 if a run failed, 2 if one has other settings, 128 and the number of the
        signal that stopped it.
    """
    options = parse(arguments)
    from training.comparison.execution import make_runs
    from training.comparison.jobs import Comparison, Evaluation
    from training.settings.train import register

    register()
    if options.ray is not None:
        # The other machines know it by this name.
        options.folder = options.folder.resolve()
    comparison = Comparison(
        options.folder,
        tuple(options.methods),
        tuple(options.overrides),
        options.seeds,
        tuple(options.learners),
        tuple(options.arms),
        Evaluation(
            tuple(options.worlds), options.episodes, options.physics, options.filter, options.plugin
        ),
    )
    try:
        status = make_runs(comparison, most=options.jobs, ray=options.ray, anew=options.anew)
    except (ValueError, files.FolderInUse) as error:
        print(f"compare.py: {error}", file=sys.stderr)
        return 2
    if status < 128:
        print(f"written: {options.folder / files.EPISODES}; now: report.py {options.folder}")
    return status


if __name__ == "__main__":
    files.run_script(main)
