"""Logging to wandb: offline by default, online or off by one setting. All of wandb is here."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from records import EpisodeRecord, ProgressRecord
from settings import TrainSettings
from torchrl_mpfa import SignalReplayBuffer

_MODES = ("offline", "online", "off")


class Tracker:
    """A wandb run, or nothing; every key is explained in ``docs/metrics.md``.

    Args:
        settings: The settings, logged as the run's configuration.
        folder: Where an offline run is kept.

    Raises:
        ValueError: If the mode is unknown.
    """

    def __init__(self, settings: TrainSettings, folder: Path) -> None:
        mode = settings.tracking.mode
        if mode not in _MODES:
            raise ValueError(f"tracking.mode must be one of {_MODES}, got {mode!r}")
        self._run: Any = None
        self._wandb: Any = None
        if mode == "off":
            return
        import wandb

        os.environ.setdefault("WANDB_SILENT", "true")
        self._wandb = wandb
        self._run = wandb.init(
            project=settings.tracking.project,
            name=folder.name,
            group=f"{settings.curriculum.name}-{settings.method.name}-{settings.learner.name}",
            mode=mode,  # type: ignore[arg-type]
            dir=folder,
            config=asdict(settings),
        )
        # An evaluation beside a run is done some steps later.
        self._run.define_metric("evaluation/*", step_metric="evaluation/step")

    def log_episode(self, record: EpisodeRecord, step: int) -> None:
        """Log one episode."""
        if self._run is None:
            return
        self._run.log(
            {
                "train/success": float(record.success),
                "train/collision": float(record.collision),
                "train/timeout": float(record.timeout),
                "train/reward": record.reward,
                "train/average_reward": record.average_reward,
                "train/steps": record.steps,
                "train/path_length": record.path_length,
                "train/episode": record.episode,
                "time/steps_per_second": record.steps / max(record.seconds, 1e-9),
            },
            step=step,
        )

    def log_progress(self, record: ProgressRecord, step: int) -> None:
        """Log an evaluation, at the step it is known at."""
        if self._run is None:
            return
        rates = ("success", "collision", "timeout", "spl")
        entries = {f"evaluation/{name}": getattr(record, name) for name in rates}
        entries["evaluation/step"] = record.total_steps
        self._run.log(entries, step=step)

    def log_update(
        self,
        step: int,
        losses: dict[str, torch.Tensor],
        buffer: SignalReplayBuffer,
        batch: TensorDictBase,
    ) -> None:
        """Log losses, values, and what the priorities are made of."""
        if self._run is None:
            return
        entries: dict[str, Any] = {
            f"loss/{name}": value.float().mean().item() for name, value in losses.items()
        }
        for name, value in buffer.stats().items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                entries[f"replay/{name}"] = value
        if "priority_weight" in batch.keys():  # noqa: SIM118 - a TensorDict iterates over rows
            entries["replay/beta"] = buffer.sampler.beta
            entries["priorities/importance_weight"] = self._histogram(batch["priority_weight"])
            for name, value in batch["signals"].items():
                entries[f"priorities/{name}"] = self._histogram(value)
        self._run.log(entries, step=step)

    def _histogram(self, values: torch.Tensor) -> Any:
        return self._wandb.Histogram(np.asarray(values.detach().cpu()))

    def close(self) -> None:
        """Finish the run."""
        if self._run is not None:
            self._run.finish()
            self._run = None
