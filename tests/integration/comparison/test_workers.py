"""Workers: what a run gives in a process that has made others, and what one that is gone costs."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.integration.comparison.test_compare import (
    EPISODES,
)
from tests.integration.tiny_runs import OVERRIDES
from training import files
from training.comparison.jobs import SCRIPTS, Evaluation, Job
from training.comparison.workers import LocalWorker, Lost
from training.records import read_table

SETTINGS = [
    *OVERRIDES,
    *("evaluation.every=30", "evaluation.episodes=2", "evaluation.world=A"),
    *("tracking.log_every=10", EPISODES.format(6)),
]
WANTED = Evaluation(("B", "rooms:7-8"), 2, "wheels")


@pytest.fixture
def worker() -> Iterator[LocalWorker]:
    made = LocalWorker()
    yield made
    made.stop()
    made.wait()


def end_of(worker: LocalWorker) -> int:
    """Exit status of what a worker runs."""
    while (status := worker.ended()) is None:
        time.sleep(0.02)
    return status


def make(worker: LocalWorker, job: Job, settings: list[str]) -> None:
    """Train and evaluate a run."""
    job.path.mkdir(parents=True)
    for command in (job.trains(settings), job.evaluates(WANTED)):
        worker.start(command, job.path / "output.log")
        assert end_of(worker) == 0, (job.path / "output.log").read_text()


def assert_same_run(one: Job, other: Job) -> None:
    """Assert that two runs have the same policy, training and evaluation to the last bit."""
    policies = [np.load(job.path / files.POLICY) for job in (one, other)]
    for name in policies[0].files:
        if policies[0][name].dtype.kind == "f":
            np.testing.assert_array_equal(policies[0][name], policies[1][name])
    timed = ["seconds", "trained_for", "plan_s", "decision_s"]
    results = one.results(WANTED).name
    for name in (files.EPISODES, files.EVALUATIONS, files.UPDATES, f"{results}/{files.EPISODES}"):
        found, expected = (
            read_table(job.path / name).drop(columns=timed, errors="ignore") for job in (one, other)
        )
        assert len(found) and found.equals(expected), name


@pytest.mark.slow
def test_runs_of_one_worker_are_those_of_the_scripts_alone_also_after_one_that_failed(
    tmp_path: Path, worker: LocalWorker
) -> None:
    settings = {"td3": [*SETTINGS, "learner.compile=true"], "ddpg": SETTINGS}
    make(worker, Job("td3", "mpfa_per", 5, tmp_path), [*settings["td3"], "threads=2"])
    failed = Job("sac", "per", 0, tmp_path)
    failed.path.mkdir()
    (failed.path / files.CHECKPOINT).write_bytes(b"no checkpoint")
    worker.start(failed.trains(SETTINGS), failed.path / "output.log")
    assert end_of(worker) == 2
    assert "damaged or not a checkpoint" in (failed.path / "output.log").read_text()
    for learner, asked in settings.items():
        job, alone = (Job(learner, "mpfa_per", 0, tmp_path / name) for name in ("one", "alone"))
        make(worker, job, asked)
        for command in (alone.trains(asked), alone.evaluates(WANTED)):
            subprocess.run([sys.executable, *command], check=True, capture_output=True)
        assert_same_run(job, alone)


@pytest.mark.slow
def test_a_script_finds_its_process_as_it_was_before_the_others(
    tmp_path: Path, worker: LocalWorker
) -> None:
    spoils, looks, log = tmp_path / "spoils.py", tmp_path / "looks.py", tmp_path / "output.log"
    looks.write_text(
        "import logging, os, sys, warnings, torch\n"
        "print(logging.root.level, logging.root.handlers)\n"
        "print(sys.argv[1:], os.getcwd(), os.environ, warnings.filters)\n"
        "print(torch.get_num_threads(), torch.rand(1), torch.tensor(1e-39) * 0.5)\n"
    )
    spoils.write_text(
        "import logging, os, sys, warnings, torch\n"
        "logging.basicConfig(level=1)\n"
        "os.chdir('/'); os.environ['NEW'] = '1'; sys.argv.append('new')\n"
        "warnings.simplefilter('error')\n"
        "torch.set_num_threads(3); torch.manual_seed(7); torch.set_flush_denormal(True)\n"
        "raise RuntimeError('it is spoilt')\n"
    )
    seen = []
    for script, status in ((looks, 0), (spoils, 1), (looks, 0)):
        log.unlink(missing_ok=True)
        worker.start([str(script), "argument"], log)
        assert end_of(worker) == status
        seen.append(log.read_text())
    assert seen[0] == seen[2]
    assert "RuntimeError: it is spoilt" in seen[1]


def test_a_worker_that_is_killed_is_lost_once_and_replaced(
    tmp_path: Path, worker: LocalWorker
) -> None:
    script, log = tmp_path / "script.py", tmp_path / "output.log"
    script.write_text(
        "import os, sys, signal\n"
        "os.kill(os.getpid(), signal.SIGKILL) if sys.argv[1:] else print('whole')\n"
    )
    worker.start([str(script), "killed"], log)
    with pytest.raises(Lost, match="its process ended with -9"):
        end_of(worker)
    worker.start([str(script)], log)
    assert end_of(worker) == 0
    assert log.read_text() == "whole\n"


def test_a_script_whose_output_has_no_room_says_so_and_its_worker_stays(
    worker: LocalWorker,
) -> None:
    help_text = [str(SCRIPTS / "train.py"), "--help"]
    worker.start(help_text, Path("/dev/full"))
    with pytest.raises(OSError, match="No space left on device"):
        end_of(worker)
    worker.start(help_text, Path("/dev/null"))
    assert end_of(worker) == 0
