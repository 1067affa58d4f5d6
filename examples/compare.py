"""Train several methods with several seeds, evaluate each run's policy, keep every episode.

    python examples/compare.py                             three methods, three seeds, two at a time
    python examples/compare.py --learners ddpg td3         two learners, 18 runs
    python examples/compare.py --worlds test mazes:test --episodes 40    a world and a generator's
    python examples/compare.py --physics wheels           evaluated on wheels, however trained
    python examples/compare.py --arm default: --arm phi2:method.boost_factor=2    two arms of each
    python examples/compare.py --folder runs/paper -- regime=paper    the paper's task
    python examples/compare.py --ray HEAD:6379            on all machines of a Ray cluster

A run of the default 50,000 actions, with its evaluation, takes some one and a half minutes of a
core: on two cores the first line takes some eight minutes, the second a quarter of an hour.

What follows ``--`` goes to ``train.py``; an arm adds settings of its own, for every learner, method
and seed. It can be stopped at any moment and continued by the same command: finished runs are left
alone, others resume from their last checkpoint, also if their machine was lost (``docs/scaling.md``
has the requirements of ``--ray``). A run that was trained with other settings is an error, or with
``--anew`` is trained again. ``report.py`` makes tables and figures from the folder. Its files:

    LEARNER-METHOD-SEED/   a run of train.py, with the output of evaluate.py; with arms
                           LEARNER-METHOD-ARM-SEED/
    episodes.csv           every evaluation episode of every run
    settings.json          what was evaluated, and the settings of the runs
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import training.extra  # noqa: F401

# isort: split
from torchrl_mpfa.spelling import unknown
from training import files
from training.comparison.arms import check_free, parse_arms
from training.comparison.execution import Runs, Start
from training.comparison.jobs import TESTED, Evaluation, Study, collect, other_than_asked
from training.comparison.processes import Child
from training.environments import check_physics
from training.settings.train import GROUPS, register
from training.stopping import Stop
from training.worlds import parse_worlds

_PAUSE = 0.3
"""Between two looks at the runs [s]."""
_JOBS = 2
"""Runs at a time on one machine."""


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
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/compare"), help="(default: runs/compare)"
    )
    parser.add_argument(
        "--jobs", type=int, help=f"runs at a time (default: {_JOBS}; with --ray as many as fit)"
    )
    parser.add_argument(
        "--ray",
        nargs="?",
        const="",
        metavar="ADDRESS",
        help="run on a Ray cluster (default: that of RAY_ADDRESS, or of this machine)",
    )
    parser.add_argument("--worlds", nargs="+", default=TESTED.words, help="(default: test)")
    parser.add_argument(
        "--episodes", type=int, default=TESTED.episodes, help="for each (default: 200)"
    )
    parser.add_argument("--physics", choices=["wheels", "kinematic"], help="default: as trained")
    parser.add_argument(
        "--arm",
        action="append",
        default=[],
        metavar="NAME:SETTING=VALUE,...",
        help="a name and its settings, added to every run; may be given several times",
    )
    parser.add_argument("--anew", action="store_true", help="train runs with other settings again")
    parser.add_argument("overrides", nargs="*", help="settings of train.py, after --")
    options = parser.parse_args(arguments)
    try:
        check_free(options.overrides)
        options.arms = parse_arms(options.arm)
        check_physics(options.physics or "kinematic")
        files.check_folder(options.folder)
    except ValueError as error:
        parser.error(str(error))
    for group in ("method", "learner", "seed"):
        names = getattr(options, f"{group}s")
        for number, name in enumerate(names):
            if group in GROUPS and name not in GROUPS[group]:
                parser.error(unknown(group, name, GROUPS[group]))
            if name in names[:number]:
                parser.error(f"--{group}s has {name} twice")
    for option in ("jobs", "episodes"):
        value = getattr(options, option)
        if value is not None and value < 1:
            parser.error(f"--{option} must be at least 1, got {value}")
    try:
        parse_worlds(options.worlds)
    except (ValueError, OSError) as error:
        parser.error(f"--worlds: {error}")
    return options


@contextmanager
def executor(address: str | None) -> Iterator[Start]:
    """Where commands are run.

    Args:
        address: Of a Ray cluster, empty for the one that there is; None: on this machine.

    Yields:
        What starts one.

    Raises:
        ValueError: If Ray is not installed, or there is no such cluster.
    """
    if address is None:
        yield Child
        return
    try:
        from training.comparison.clusters import RemoteChild, connected
    except ImportError as error:
        raise ValueError("--ray needs Ray: pip install 'torchrl-mpfa[ray]'") from error
    try:
        with connected(address or None):
            yield RemoteChild
    except ConnectionError as error:
        raise ValueError(f"--ray {address}: {error}") from error


def run_all(runs: Runs) -> Stop:
    """Train and evaluate, some at a time.

    Args:
        runs: What there is to do.

    Returns:
        Whether all was stopped.
    """
    stop = Stop("saving the runs; the same command continues them")
    with stop.listening():
        while runs and not stop:
            runs.begin()
            time.sleep(_PAUSE)
            runs.look()
        runs.stop()
    return stop


def main(arguments: Sequence[str] | None = None) -> int:
    """Train what is not trained, evaluate it, collect the rows.

    Args:
        arguments: The command line.

    Returns:
        Exit status: 1 if a run failed, 2 if one has other settings, 128 and the number of the
        signal that stopped it.
    """
    options = parse(arguments)
    register()
    if options.ray is not None:
        # The other machines know it by this name.
        options.folder = options.folder.resolve()
    study = Study(
        options.folder,
        tuple(options.methods),
        tuple(options.overrides),
        options.seeds,
        tuple(options.learners),
        tuple(options.arms),
        Evaluation(tuple(options.worlds), options.episodes, options.physics),
    )
    jobs, wanted = study.jobs, study.evaluation
    try:
        with files.lock(options.folder):
            others = other_than_asked(jobs, options.overrides)
            if others and not options.anew:
                job, found = next(iter(others.items()))
                raise ValueError(
                    f"{job.path} was trained with {'; '.join(found)}: name another --folder, or "
                    "train it again with --anew"
                )
            waiting = [job for job in jobs if job in others or not job.is_evaluated(wanted)]
            print(f"{len(jobs)} runs, {len(jobs) - len(waiting)} of them done, in {options.folder}")
            with executor(options.ray if waiting else None) as start:
                most = options.jobs or (_JOBS if options.ray is None else len(waiting))
                runs = Runs(
                    waiting, options.overrides, wanted, anew=set(others), start=start, most=most
                )
                stop = run_all(runs)
            if stop:
                return stop.exit_status
            collect(jobs, wanted, options.folder)
    except (ValueError, files.FolderInUse) as error:
        print(f"compare.py: {error}", file=sys.stderr)
        return 2
    print(f"written: {options.folder / files.EPISODES}; now: report.py {options.folder}")
    return 1 if runs.failed else 0


if __name__ == "__main__":
    sys.exit(main())
