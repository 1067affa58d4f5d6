"""Workers: what a run gives in a process that has made others, and what one that is gone costs."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest

import compare
from tests.integration.comparison.test_compare import InThisProcess, assert_same_rows, comparison
from training import files
from training.comparison import execution
from training.comparison.jobs import SCRIPTS, Evaluation, Job
from training.comparison.workers import LocalWorker, Lost
from training.records import read_table

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


ray = pytest.importorskip("ray", reason="an extra: pip install 'torchrl-mpfa[ray]'")
pytestmark = pytest.mark.slow


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Two machines of one core; the first one has the comparison."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        yield made
    finally:
        ray.shutdown()
        made.shutdown()


def test_a_comparison_loses_a_machine_and_gives_the_rows_of_one_machine(
    tmp_path: Path,
    cluster: Any,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    other = cluster.add_node(num_cpus=1)
    arguments = [*comparison(tmp_path / "ray", "--ray", cluster.address, length=60)]
    arguments.append("checkpoint_every=20")

    def lose() -> None:
        """Take the second machine away once both runs have a checkpoint."""
        runs = [tmp_path / "ray" / f"ddpg-{name}-0" for name in ("mpfa_per", "uniform")]
        while not all((run / files.CHECKPOINT).exists() for run in runs):
            time.sleep(0.05)
        cluster.remove_node(other, allow_graceful=False)

    thread = Thread(target=lose, daemon=True)
    thread.start()
    assert compare.main(arguments) == 0
    assert not thread.is_alive()
    assert capsys.readouterr().out.count("its worker is gone, resumes at its last") == 1
    # Neither run was begun twice.
    assert not list((tmp_path / "ray").glob(f"*/{files.PREVIOUS}"))

    arguments[1] = str(tmp_path / "serial")
    arguments.remove("--ray")
    arguments.remove(cluster.address)
    monkeypatch.setattr(execution, "LocalWorker", InThisProcess)
    assert compare.main(arguments) == 0
    assert_same_rows(tmp_path / "ray", tmp_path / "serial")
    kept = json.loads((tmp_path / "ray" / files.SETTINGS).read_text())
    assert set(kept["runs"]) == {"ddpg-mpfa_per-0", "ddpg-uniform-0"}
