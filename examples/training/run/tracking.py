"""What a run logs, and to wandb: offline by default, online or off by one setting.

All of wandb is here; TorchRL's loggers that may be beside it are in ``loggers.py``.
"""

from __future__ import annotations

import os
import re
import secrets
import shlex
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import wandb
from tensordict import TensorDictBase

from torchrl_mpfa import SignalReplayBuffer
from training.records import AssessmentRecord, EpisodeRecord, EvaluationRecord
from training.run.loggers import CSVLog, Log, TensorboardLog
from training.settings.train import TrackingSettings, TrainSettings

AXIS = "actions"
"""What every entry is plotted over: actions of all robots so far."""


class Tracker:
    """The logs of a run; every name is explained in ``docs/metrics.md``.

    Args:
        settings: The settings, logged as the run's configuration.
        folder: Of the run, where logs are kept.
        run_id: wandb's of the run that is gone on with; it stays one run.
        actions: After which the run goes on; 0: it begins.
    """

    def __init__(
        self, settings: TrainSettings, folder: Path, *, run_id: str | None, actions: int = 0
    ) -> None:
        # A sweep has given its run an id.
        self.run_id = run_id or os.environ.get("WANDB_RUN_ID") or secrets.token_hex(4)
        wanted = settings.tracking
        self._logs: list[Log] = []
        self.upload = upload_command(wanted, folder, self.run_id)
        """What uploads the run to wandb, if it is kept offline."""
        if wanted.mode != "off":
            self._logs.append(WandbLog(settings, folder, run_id=self.run_id))
        if wanted.csv:
            self._logs.append(CSVLog(folder, actions=actions))
        if wanted.tensorboard:
            self._logs.append(TensorboardLog(folder, actions=actions))

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
        if not self._logs:
            return  # The statistics would take their time.
        entries: dict[str, Any] = {
            f"loss/{name}": value.float().mean().item() for name, value in losses.items()
        }
        for name, value in buffer.stats().items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                entries[f"replay/{name}"] = value
        if "priority_weight" in batch.keys():  # noqa: SIM118 - a TensorDict iterates over rows
            entries["replay/beta"] = buffer.sampler.beta
            entries["priorities/importance_weight"] = batch["priority_weight"].detach().cpu()
            for name, value in batch["signals"].items():
                entries[f"priorities/{name}"] = value.detach().cpu()
        self._log(entries, step)

    @property
    def shows(self) -> bool:
        """Whether there is a log for pictures."""
        return any(not isinstance(log, CSVLog) for log in self._logs)

    def log_policy(
        self, entries: Mapping[str, Any], *, file: Path, card: Mapping[str, Any], actions: int
    ) -> None:
        """Log pictures and tables of what a policy does, and to wandb the policy."""
        self._log(entries, actions)
        for log in self._logs:
            if isinstance(log, WandbLog):
                log.keep(file, card)

    def _log(self, entries: Mapping[str, Any], actions: int) -> None:
        for log in self._logs:
            log.log(entries, actions)

    def flush(self) -> None:
        """See that what was logged is kept, however this process ends."""
        for log in self._logs:
            log.flush()

    def close(self) -> None:
        """Finish the logs."""
        for log in self._logs:
            log.close()


class WandbLog:
    """A run of wandb, the same one however often it goes on.

    What a run does again after a checkpoint is logged once: how far it was logged is in a file,
    since wandb does not tell it of an offline run.

    Args:
        settings: Of the run, its configuration.
        folder: Of the run, where wandb keeps it.
        run_id: Of the run.
    """

    def __init__(self, settings: TrainSettings, folder: Path, *, run_id: str) -> None:
        os.environ.setdefault("WANDB_SILENT", "true")
        parts = [settings.curriculum.name or "", settings.method.name, settings.learner.name]
        try:
            self._run: Any = wandb.init(
                project=settings.tracking.project,
                id=run_id,
                resume="allow",
                name=folder.name,
                group=settings.tracking.group or "-".join(parts)[:128],
                job_type="train",
                tags=[part[:64] for part in (*parts, settings.regime)],
                mode=settings.tracking.mode,  # type: ignore[arg-type]
                dir=folder,
                config=asdict(settings),
                allow_val_change=True,
            )
        except wandb.Error as error:
            raise ValueError(
                f"tracking.mode={settings.tracking.mode}: wandb says {str(error).rstrip('.')}; "
                "tracking=wandb keeps the run on this machine"
            ) from error
        # wandb's own step takes one value of a key, and several episodes may end at one action.
        self._run.define_metric("*", step_metric=AXIS)
        self._path = folder / "wandb" / f"logged-{run_id}.txt"
        self._path.parent.mkdir(exist_ok=True)
        self._path.touch()
        words = self._path.read_text().split() or (self._run.step, -1)
        self._entries, self._before = map(int, words)
        self._actions = self._before

    def log(self, entries: Mapping[str, Any], actions: int) -> None:
        """Log entries, unless that was done before the run was stopped."""
        if actions <= self._before:
            return
        shown = {name: _as_wandb(value) for name, value in entries.items()}
        self._run.log({**shown, AXIS: actions}, step=self._entries, commit=True)
        self._entries, self._actions = self._entries + 1, max(self._actions, actions)
        # Not emptied first: the new numbers are as long as the old ones, or longer.
        with self._path.open("r+") as file:
            file.write(f"{self._entries} {self._actions}")

    def keep(self, file: Path, card: Mapping[str, Any]) -> None:
        """Keep a policy as an artifact, whose versions are those of runs with the same name."""
        name = re.sub(r"[^\w.-]", "-", f"policy-{file.parent.name}")[:128]
        artifact = wandb.Artifact(name, type="policy", metadata=dict(card))
        artifact.add_file(str(file))
        self._run.log_artifact(artifact)

    def flush(self) -> None:
        """Do nothing: wandb has a process of its own, which outlives this one."""

    def close(self) -> None:
        """Finish the run."""
        self._run.finish()


def _as_wandb(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return wandb.Histogram(np.asarray(value))
    if isinstance(value, np.ndarray):
        return wandb.Image(value)
    if isinstance(value, pd.DataFrame):
        return wandb.Table(dataframe=value)
    if isinstance(value, Path):
        return wandb.Video(str(value), format="gif")
    return value


def upload_command(wanted: TrackingSettings, folder: Path, run_id: str) -> str | None:
    """The command line that uploads all parts of an offline run, as one run.

    Examples:
        >>> upload_command(TrackingSettings(mode="offline"), Path("runs/demo"), "1a2b3c4d")
        'wandb sync runs/demo/wandb/offline-run-*-1a2b3c4d'
    """
    if wanted.mode != "offline":
        return None
    return f"wandb sync {shlex.quote(str(folder))}/wandb/offline-run-*-{run_id}"
