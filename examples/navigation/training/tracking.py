"""Logging to wandb: offline by default, online or off by one setting. All of wandb is here."""

from __future__ import annotations

import os
import secrets
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import wandb
from tensordict import TensorDictBase

from navigation.records import AssessmentRecord, EpisodeRecord, EvaluationRecord
from navigation.settings.train import TrainSettings
from torchrl_mpfa import SignalReplayBuffer

AXIS = "actions"
"""What every entry is plotted over: actions of all robots so far."""
_MODES = {"offline": "offline", "online": "online", "off": "disabled"}


class Tracker:
    """A wandb run; every key is explained in ``docs/metrics.md``.

    Args:
        settings: The settings, logged as the run's configuration.
        folder: Where an offline run is kept.
        run_id: Of the run that is gone on with; it stays one run.
    """

    def __init__(self, settings: TrainSettings, folder: Path, *, run_id: str | None) -> None:
        os.environ.setdefault("WANDB_SILENT", "true")
        parts = [settings.curriculum.name or "", settings.method.name, settings.learner.name]
        self.run_id = run_id or secrets.token_hex(4)
        self._run: Any = wandb.init(
            project=settings.tracking.project,
            id=self.run_id,
            resume="allow",
            name=folder.name,
            group="-".join(parts),
            job_type="train",
            tags=[part[:64] for part in parts],
            mode=_MODES[settings.tracking.mode],  # type: ignore[arg-type]
            dir=folder,
            config=asdict(settings),
            allow_val_change=True,
        )
        # wandb's own step takes one value of a key, and several episodes may end at one action.
        self._run.define_metric("*", step_metric=AXIS)

    def log_episode(self, record: EpisodeRecord) -> None:
        """Log one episode."""
        entries: dict[str, Any] = {
            f"train/{name}": float(getattr(record, name))
            for name in ("success", "collision", "timeout", "reward", "average_reward")
        }
        entries["train/steps"] = record.steps
        entries["train/path_length"] = record.path_length
        entries["train/episode"] = record.episode
        entries["time/steps_per_second"] = record.total_steps / max(record.seconds, 1e-9)
        self._log(entries, record.total_steps)

    def log_evaluation(self, record: EvaluationRecord) -> None:
        """Log an evaluation."""
        rates = ("success", "collision", "timeout", "spl")
        entries = {f"evaluation/{name}": getattr(record, name) for name in rates}
        self._log(entries, record.total_steps)

    def log_assessment(self, record: AssessmentRecord) -> None:
        """Log an assessment."""
        names = ("episodes", "least", "kept")
        entries = {f"assessment/{name}": float(getattr(record, name)) for name in names}
        self._log(entries, record.total_steps)

    def log_update(
        self,
        step: int,
        losses: dict[str, torch.Tensor],
        buffer: SignalReplayBuffer,
        batch: TensorDictBase,
    ) -> None:
        """Log losses, values, and what the priorities are made of."""
        if self._run.disabled:
            return  # The histograms would take their time.
        entries: dict[str, Any] = {
            f"loss/{name}": value.float().mean().item() for name, value in losses.items()
        }
        for name, value in buffer.stats().items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                entries[f"replay/{name}"] = value
        if "priority_weight" in batch.keys():  # noqa: SIM118 - a TensorDict iterates over rows
            entries["replay/beta"] = buffer.sampler.beta
            entries["priorities/importance_weight"] = _histogram(batch["priority_weight"])
            for name, value in batch["signals"].items():
                entries[f"priorities/{name}"] = _histogram(value)
        self._log(entries, step)

    def _log(self, entries: dict[str, Any], actions: int) -> None:
        self._run.log({**entries, AXIS: actions})

    def close(self) -> None:
        """Finish the run."""
        self._run.finish()


def _histogram(values: torch.Tensor) -> Any:
    return wandb.Histogram(np.asarray(values.detach().cpu()))
