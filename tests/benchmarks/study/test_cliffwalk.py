"""The command of the cliffwalk, and its oracle."""

from __future__ import annotations

import csv
import math

import torch

from benchmarks.study import cliffwalk
from benchmarks.study.cliffwalk import batch_size_of, oracle_updates
from tests.mpfa.test_cliffwalk import rows_of
from torchrl_mpfa.cliffwalk import Cliffwalk, CliffwalkValues, updates_to_convergence
from torchrl_mpfa.methods import make_replay


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


def test_the_oracle_chooses_what_lowers_the_error_most() -> None:
    cliff, seed = Cliffwalk(3), 1
    generator = torch.Generator().manual_seed(seed)
    kinds = sorted(set(rows_of(cliff, generator)))
    values = CliffwalkValues(cliff, generator=generator)
    count = 0
    while values.error >= 1e-3:
        errors = []
        for kind in kinds:
            trial = CliffwalkValues(cliff)
            trial.q = [list(row) for row in values.q]
            trial.learn(*kind)
            truth = [
                [v * (a == r) for v, r in zip(cliff.values, cliff.right, strict=True)]
                for a in (0, 1)
            ]
            errors.append(
                sum(
                    (q - t) ** 2
                    for row, true in zip(trial.q, truth, strict=True)
                    for q, t in zip(row, true, strict=True)
                )
            )
        values.learn(*kinds[errors.index(min(errors))])
        count += 1
    assert oracle_updates(cliff, seed=seed) == count


def test_an_oracle_needs_fewer_updates_than_per_or_gives_up() -> None:
    cliff = Cliffwalk(7)
    generator = torch.Generator().manual_seed(0)
    per = make_replay(
        "per", capacity=cliff.size, batch_size=batch_size_of(cliff), generator=generator, eps=1e-3
    )
    assert oracle_updates(cliff) < updates_to_convergence(cliff, per.buffer)
    assert oracle_updates(Cliffwalk(4), limit=5) == math.inf
