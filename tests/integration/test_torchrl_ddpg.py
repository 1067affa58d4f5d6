"""TorchRL's DDPG with our replay on one page: it learns by all three signals."""

from __future__ import annotations

import pytest
import torch

import torchrl_ddpg


def test_every_signal_of_what_was_replayed_is_known(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torchrl_ddpg, "BATCH_SIZE", 32)
    buffer = torchrl_ddpg.main(["--actions", "256"])
    table = buffer.sampler.table
    rows = table.rows[: table.size]
    replayed = rows[:, table.count_column] > 0
    assert len(buffer) == 256
    assert torch.equal(rows[:, table.fused].isfinite().all(1), replayed)
    assert replayed.sum() > 100
    assert buffer.stats()["stale_updates"] == 0
    assert capsys.readouterr().out.count("weight of ") == 3
