"""Train several methods with several seeds, evaluate the last policy of each, keep every episode.

    python examples/compare.py                             three methods, three seeds, two at a time
    python examples/compare.py --learners ddpg td3         two learners, too
    python examples/compare.py --seeds 0 --methods per --folder runs/try -- curriculum=A

What follows ``--`` goes to ``train.py``. Stopped at any moment, the same command goes on: finished
runs are left alone, others continue at their last checkpoint. ``report.py`` makes tables and
figures of the folder. Files in it:

    LEARNER-METHOD-SEED/   a run of train.py, and test.csv, a row per evaluation episode
    episodes.csv           all rows of all test.csv, with learner, method and seed
"""

from __future__ import annotations

import argparse
import csv
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import torch
from tqdm import tqdm

from environments import make_evaluation_env
from evaluation import EpisodeResult, greedy, run_episodes
from mpfa_envs import evaluation_pairs
from records import load_policy, write_rows
from settings import GROUPS, Environment

HERE = Path(__file__).parent
DONE = "test.csv"
RESULT_FIELDS = [entry.name for entry in fields(EpisodeResult)]


@dataclass(frozen=True)
class Job:
    """One training run."""

    learner: str
    method: str
    seed: int
    folder: Path

    @property
    def name(self) -> str:
        """Name of the run, and of its folder."""
        return f"{self.learner}-{self.method}-{self.seed}"

    @property
    def path(self) -> Path:
        """Folder of the run."""
        return self.folder / self.name

    @property
    def is_done(self) -> bool:
        """Whether it was trained and evaluated."""
        return (self.path / DONE).exists()

    def command(self, overrides: Sequence[str]) -> list[str]:
        """How it is started, or continued where a checkpoint lies."""
        script = [sys.executable, str(HERE / "train.py")]
        if (self.path / "checkpoint.pt").exists():
            return [*script, f"resume={self.path}"]
        return [
            *script,
            f"learner={self.learner}",
            f"method={self.method}",
            f"seed={self.seed}",
            f"run_dir={self.path}",
            *overrides,
        ]


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
    parser.add_argument("--world", default="test", help="map of the evaluation (default: test)")
    parser.add_argument("--episodes", type=int, default=200, help="its pairs (default: 200)")
    parser.add_argument("overrides", nargs="*", help="settings of train.py, after --")
    options = parser.parse_args(arguments)
    for group, names in (("method", options.methods), ("learner", options.learners)):
        for name in names:
            if name not in GROUPS[group]:
                parser.error(f"unknown {group} {name!r}; there are: {', '.join(GROUPS[group])}")
    for name in ("jobs", "episodes"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(options, name)}")
    return options


DEFAULTS = ("curriculum=paper", "learner.lr_power=1", "tracking=off", "evaluation.every=5000")


def with_defaults(overrides: Sequence[str]) -> list[str]:
    """The settings of the study, but where the command line has others."""
    given = {override.split("=")[0] for override in overrides}
    return [*(d for d in DEFAULTS if d.split("=")[0] not in given), *overrides]


class Running:
    """A training process, and its line on the screen.

    Args:
        job: What to train.
        overrides: Settings of ``train.py``.
        position: Line of its progress bar.
    """

    def __init__(self, job: Job, overrides: Sequence[str], *, position: int) -> None:
        self.job = job
        self.position = position
        job.path.mkdir(parents=True, exist_ok=True)
        self._log = (job.path / "output.log").open("ab")
        self._process = subprocess.Popen(
            job.command(overrides), stdout=self._log, stderr=subprocess.STDOUT
        )
        self._bar = tqdm(desc=job.name, unit="episode", position=position, leave=False)

    def refresh(self) -> None:
        """Move the bar to where the log of the process is."""
        with (self.job.path / "output.log").open("rb") as file:
            file.seek(max(0, file.seek(0, 2) - 400))
            tail = file.read().decode(errors="replace")
        found = re.findall(r"(\d+)/(\d+) \[[^\]]*?(success \d+%)?[^\]]*\]", tail)
        if found:
            done, total, success = found[-1]
            self._bar.total = int(total)
            self._bar.n = int(done)
            self._bar.set_postfix_str(success)

    def ended(self) -> int | None:
        """Exit status, or None while it runs."""
        status = self._process.poll()
        if status is not None:
            self._bar.close()
            self._log.close()
        return status

    def interrupt(self) -> None:
        """Ask it to save and stop, and wait for that."""
        self._process.wait()
        self.ended()


def drive(run: Path, *, world: str, episodes: int) -> list[EpisodeResult]:
    """Drive the last policy of a run greedily between the fixed pairs of a map."""
    policy, state = load_policy(run)
    env = make_evaluation_env(world, Environment(**state["environment"]))
    tasks = evaluation_pairs(world, episodes, 0, robot=env.robot)
    results, _ = run_episodes(env, greedy(policy), tasks, progress=False)
    env.close()
    return results


def collect(jobs: Sequence[Job], path: Path) -> None:
    """Write the rows of all finished runs in one file."""
    rows: list[dict[str, str]] = []
    for job in jobs:
        if job.is_done:
            which = {"learner": job.learner, "method": job.method, "seed": str(job.seed)}
            with (job.path / DONE).open(encoding="utf-8", newline="") as file:
                rows += [{**which, **row} for row in csv.DictReader(file)]
    write_rows(rows, ["learner", "method", "seed", *RESULT_FIELDS], path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train what is not trained, evaluate it, collect the rows.

    Args:
        arguments: The command line.

    Returns:
        Exit status: 1 if a run failed.
    """
    options = parse(arguments)
    torch.set_num_threads(1)
    overrides = with_defaults(options.overrides)
    jobs = [
        Job(learner, method, seed, options.folder)
        # Seeds outside: a study that is cut short has as much of each method.
        for seed in options.seeds
        for learner in options.learners
        for method in options.methods
    ]
    waiting = [job for job in jobs if not job.is_done]
    print(f"{len(jobs)} runs, {len(jobs) - len(waiting)} of them done, in {options.folder}")
    running: list[Running] = []
    failed: list[Job] = []
    try:
        while waiting or running:
            while waiting and len(running) < options.jobs:
                free = min(set(range(options.jobs)) - {each.position for each in running})
                running.append(Running(waiting.pop(0), overrides, position=free))
            time.sleep(1.0)
            for each in list(running):
                each.refresh()
                status = each.ended()
                if status is None:
                    continue
                running.remove(each)
                if status == 0:
                    path = each.job.path
                    results = drive(path, world=options.world, episodes=options.episodes)
                    write_rows([asdict(r) for r in results], RESULT_FIELDS, path / DONE)
                    tqdm.write(f"{each.job.name}: trained and evaluated")
                else:
                    failed.append(each.job)
                    tqdm.write(f"{each.job.name}: failed, see {each.job.path / 'output.log'}")
    except KeyboardInterrupt:
        # The terminal has sent Ctrl-C to the runs as well: they save after their episode.
        print("\nwaiting for the runs to save; the same command goes on with them")
        for each in running:
            each.interrupt()
        return 130
    collect(jobs, options.folder / "episodes.csv")
    print(f"written: {options.folder / 'episodes.csv'}; now: report.py {options.folder}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
