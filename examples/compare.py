"""Train several methods with several seeds, evaluate the last policy of each, keep every episode.

    python examples/compare.py                             three methods, three seeds, two at a time
    python examples/compare.py --learners ddpg td3         two learners, too
    python examples/compare.py --worlds test mazes:test --episodes 40    a world, a generator's
    python examples/compare.py --physics wheels           evaluated on wheels, however trained
    python examples/compare.py --arm default: --arm phi2:method.boost_factor=2    two arms of each
    python examples/compare.py --folder runs/paper -- regime=paper    the paper's task

What follows ``--`` goes to ``train.py``; an arm has settings of its own on top, for every learner,
method and seed. Stopped at any moment, the same command goes on: finished
runs are left alone, others continue at their last checkpoint. A run that was trained with other
settings is an error, or with ``--anew`` trained again. ``report.py`` makes tables and figures of
the folder. Files in it:

    LEARNER-METHOD-SEED/   a run of train.py, and what evaluate.py wrote of it; with arms
                           LEARNER-METHOD-ARM-SEED/
    episodes.csv           every evaluation episode of every run
    settings.json          what was evaluated, and the settings of the runs
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from navigation import files
from navigation.arms import check_free, parse_arms
from navigation.processes import Child
from navigation.settings import GROUPS, register
from navigation.stopping import Stop
from navigation.studies import TESTED, Evaluation, Job, Study, collect, other_than_asked
from navigation.worlds import parse_worlds
from torchrl_mpfa.spelling import unknown

_PAUSE = 0.3
"""Between two looks at the runs [s]."""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", nargs="+", default=["mpfa_per", "per", "uniform"])
    parser.add_argument("--learners", nargs="+", default=["ddpg"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--folder", type=Path, default=Path("runs/compare"))
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time (default: 2)")
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
        help="other settings by a name, for every run; may be given several times",
    )
    parser.add_argument("--anew", action="store_true", help="train runs of other settings again")
    parser.add_argument("overrides", nargs="*", help="settings of train.py, after --")
    options = parser.parse_args(arguments)
    try:
        check_free(options.overrides)
        options.arms = parse_arms(options.arm)
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
        if getattr(options, option) < 1:
            parser.error(f"--{option} must be at least 1, got {getattr(options, option)}")
    try:
        parse_worlds(options.worlds)
    except (ValueError, OSError) as error:
        parser.error(f"--worlds: {error}")
    return options


class Running:
    """A run on its way: trained first, then evaluated, with a line on the screen.

    Args:
        job: The run.
        training: The command that trains it; None if that is done.
        evaluation: The command that evaluates it.
        position: Its line.
    """

    def __init__(
        self, job: Job, training: list[str] | None, evaluation: list[str], *, position: int
    ) -> None:
        self.job = job
        self.position = position
        self._commands = [evaluation] if training is None else [training, evaluation]
        job.path.mkdir(parents=True, exist_ok=True)
        self.log = job.path / "output.log"
        self._bar = tqdm(desc=job.name, unit="episode", position=position, leave=False)
        self._child = Child(self._commands.pop(0), self.log)

    def ended(self) -> int | None:
        """Exit status of the last command, or of one that failed; None while it runs."""
        status = self.job.status()
        self._bar.total, self._bar.n = status.get("total"), status.get("done", 0)
        self._bar.unit = status.get("unit", "it")
        self._bar.set_postfix_str(status.get("summary", "") if self._commands else "evaluation")
        exit_status = self._child.ended()
        if exit_status == 0 and self._commands:
            self._child = Child(self._commands.pop(0), self.log)
            return None
        if exit_status is not None:
            self._bar.close()
        return exit_status

    def stop(self) -> None:
        """Ask it to save and end."""
        self._child.stop(signal.SIGTERM)

    def wait(self) -> None:
        """Wait until it has."""
        self._child.wait()
        self._bar.close()


def run_all(
    waiting: list[Job], options: argparse.Namespace, wanted: Evaluation, anew: set[Job]
) -> tuple[list[Job], Stop]:
    """Train and evaluate, some at a time.

    Args:
        waiting: The runs that are not done.
        options: The command line.
        wanted: What their policies shall do.
        anew: Runs to train again from the start.

    Returns:
        Those that failed, and whether all was stopped.
    """
    running: list[Running] = []
    failed: list[Job] = []
    stop = Stop("saving the runs; the same command continues them")
    with stop.listening():
        while (waiting or running) and not stop:
            while waiting and len(running) < options.jobs:
                job = waiting.pop(0)
                free = min(set(range(options.jobs)) - {each.position for each in running})
                trained = job.is_trained() and job not in anew
                training = None if trained else job.trains(options.overrides, anew=job in anew)
                running.append(Running(job, training, job.evaluates(wanted), position=free))
            time.sleep(_PAUSE)
            for each in list(running):
                status = each.ended()
                if status is None:
                    continue
                running.remove(each)
                if status == 0:
                    tqdm.write(f"{each.job.name}: trained and evaluated")
                else:
                    failed.append(each.job)
                    tqdm.write(f"{each.job.name}: failed, see {each.log}")
        for each in running:
            each.stop()
        for each in running:
            each.wait()
    return failed, stop


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
                    "train it again by --anew"
                )
            waiting = [job for job in jobs if job in others or not job.is_evaluated(wanted)]
            print(f"{len(jobs)} runs, {len(jobs) - len(waiting)} of them done, in {options.folder}")
            failed, stop = run_all(waiting, options, wanted, set(others))
            if stop:
                return stop.exit_status
            collect(jobs, wanted, options.folder)
    except (ValueError, files.FolderInUse) as error:
        print(f"compare.py: {error}", file=sys.stderr)
        return 2
    print(f"written: {options.folder / files.EPISODES}; now: report.py {options.folder}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
