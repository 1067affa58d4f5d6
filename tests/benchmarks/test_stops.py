"""Stops of training runs: files that count as damaged, the table, and one real stop."""

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import stops
from torchrl_mpfa.saving import save_atomically

ROOT = Path(__file__).parents[2]


def test_files_that_are_cut_short_or_left_half_written_are_damaged(tmp_path):
    save_atomically({"step": 3}, tmp_path / "checkpoint.pt")
    (tmp_path / "csv").mkdir()
    (tmp_path / "csv" / "reward.csv").write_text("1,2.0\n2,3.0\n")
    (tmp_path / "status.json").write_text("{}")
    (tmp_path / ".lock").touch()
    assert stops.damaged(tmp_path) == ""
    whole = (tmp_path / "checkpoint.pt").read_bytes()
    (tmp_path / "checkpoint.pt").write_bytes(whole[:-1])
    (tmp_path / "csv" / "reward.csv").write_text("1,2.0\n2,3")
    (tmp_path / "status.json").write_text("{")
    (tmp_path / ".policy.npz.7.tmp").touch()
    names = stops.damaged(tmp_path).split()
    assert sorted(names) == [".policy.npz.7.tmp", "checkpoint.pt", "reward.csv", "status.json"]


def test_the_table_counts_faults_by_kind():
    row = {"kind": "SIGKILL", "phase": "write", "lost": 8, "resumed": 0}
    row |= dict.fromkeys(("damaged", "differs", "missing", "damaged_after"))
    rows = [
        row,
        row | {"phase": "update", "lost": 40, "damaged": ".a.tmp"},
        row | {"differs": "policy.npz"},
        row | {"missing": "histograms.png"},
        row | {"resumed": 1, "damaged": ".a.tmp status.json"},
        row | {"kind": "disk", "lost": 0},
    ]
    lines = stops.report(pd.DataFrame(rows)).splitlines()
    assert lines[2] == "| SIGKILL | 5 | write 4, update 1 | 40 | 2 | 1 |"
    assert lines[3] == "| disk | 1 | write 1 | 0 | 1 | 0 |"


@pytest.mark.slow
def test_a_run_that_is_stopped_by_a_signal_loses_nothing(tmp_path):
    rows = tmp_path / "rows.csv"
    words = ["--kinds", "SIGTERM", "--trials", "2", "--rows", str(rows)]
    command = [sys.executable, "-m", "benchmarks.stops", *words]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    table = pd.read_csv(rows)
    assert table.trial.tolist() == [0, 1]
    assert (table.lost == 0).all() and (table.resumed == 0).all()
    assert table[["differs", "missing", "damaged_after"]].isna().all(axis=None)
    assert table.phase[1] == "drive" and table.status[1] == 143
    # They are not made again.
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=60)
    assert pd.read_csv(rows).equals(table)
