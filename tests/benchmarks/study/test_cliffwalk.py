"""The script of the cliffwalk: a table, a figure, and refusals."""

from __future__ import annotations

import csv

import pytest

from benchmarks.study import cliffwalk


def test_it_writes_a_row_for_each_run_and_a_figure(tmp_path, capsys):
    assert cliffwalk.main(["--lengths", "4,2", "--seeds", "2", "--output", str(tmp_path)]) == 0
    with (tmp_path / "cliffwalk.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * len(cliffwalk.ARMS)
    assert {row["replay"] for row in rows} == set(cliffwalk.ARMS)
    assert [row["length"] for row in rows] == sorted(row["length"] for row in rows)
    assert (tmp_path / "cliffwalk.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    of_oracle = [float(r["updates"]) for r in rows if r["replay"] == cliffwalk.ORACLE]
    assert f"{sum(of_oracle[2:]) / 2:.0f}" in printed


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--lengths", "1"], "length"),
        (["--lengths", "a"], "--lengths"),
        (["--seeds", "0"], "--seeds"),
        (["--eps", "-1"], "--eps"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(arguments, word, tmp_path, capsys):
    with pytest.raises(SystemExit):
        cliffwalk.main([*arguments, "--output", str(tmp_path / "new")])
    assert word in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
