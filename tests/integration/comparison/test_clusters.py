"""Comparisons on a real Ray cluster, of two machines that are simulated on this one."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

import compare
from tests.integration.comparison.test_compare import InThisProcess, assert_same_rows, comparison
from training import files
from training.comparison import execution

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
