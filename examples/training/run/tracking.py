"""The logs of a run: wandb, in ``wandb_log.py``, and TorchRL's loggers, in ``loggers.py``."""

from __future__ import annotations

import os
import secrets
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from PIL import Image
from tensordict import TensorDictBase

from training import files
from training.inherited import with_environment
from training.pictures import trajectories_of
from training.records import EpisodeRecord, EvaluationRecord
from training.run.checkpoints import read_checkpoint
from training.run.hooks import Hook
from training.run.loggers import CSVLog, Log, TensorboardLog
from training.settings.rules import settings_by_name
from training.settings.train import TrackingSettings, TrainSettings, as_settings

if TYPE_CHECKING:
    from training.run.loop import TrainingRun
    from training.run.wandb_log import WandbLog


_RATES = ("success", "collision", "timeout", "spl", "sct")
"""Numbers of an evaluation."""
_SMALL = 240
"""Width of a world in pictures during the training [px]; they take 0.1 s each."""


class Tracker(Hook):
    """The logs of a run; every name is explained in ``docs/metrics.md``.

    Args:
        settings: The settings, logged as the run's configuration.
        folder: Of the run, where logs are kept.
        run_id: wandb's id of a run that resumes; it stays one run.
        actions: Actions after which the run resumes; 0: it begins.
    """

    def __init__(
        self, settings: TrainSettings, folder: Path, *, run_id: str | None, actions: int = 0
    ) -> None:
        # A sweep has given its run an id.
        self.run_id = run_id or os.environ.get("WANDB_RUN_ID") or secrets.token_hex(4)
        wanted = with_environment(settings.tracking)
        self._pictures = wanted.pictures_every is not None
        self._logs: list[Log] = []
        self.upload = upload_command(wanted, folder, self.run_id)
        """Command that uploads the run to wandb, if it is kept offline."""
        self._wandb: WandbLog | None = None
        if wanted.mode != "off":
            # Imports wandb, which takes a second.
            from training.run.wandb_log import WandbLog

            self._wandb = WandbLog(settings, folder, run_id=self.run_id)
            self._logs.append(self._wandb)
        if wanted.csv:
            self._logs.append(CSVLog(folder, actions=actions))
        if wanted.tensorboard:
            named = dict(settings_by_name(settings))
            self._logs.append(TensorboardLog(folder, actions=actions, settings=named))

    def on_episode(self, run: TrainingRun, record: EpisodeRecord) -> None:
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

    def on_evaluation(self, run: TrainingRun, record: EvaluationRecord) -> None:
        """Log an evaluation, with a picture of its paths where a log can show it."""
        entries: dict[str, Any] = {f"evaluation/{name}": getattr(record, name) for name in _RATES}
        if self.shows and run.driven is not None:
            entries["evaluation/paths"] = trajectories_of([run.driven], size=_SMALL)
        self._log(entries, record.total_steps)

    def on_update(
        self, run: TrainingRun, losses: dict[str, torch.Tensor], batch: TensorDictBase
    ) -> None:
        """Log losses, values, and what the priorities are made of."""
        if not self._logs:
            return  # The statistics would take their time.
        entries: dict[str, Any] = {
            f"loss/{name}": value.float().mean().item() for name, value in losses.items()
        }
        for name, value in run.buffer.stats().items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                entries[f"replay/{name}"] = value
        if "priority_weight" in batch.keys():  # noqa: SIM118 - a TensorDict iterates over rows
            entries["replay/beta"] = run.buffer.sampler.beta
            entries["priorities/importance_weight"] = batch["priority_weight"].detach().cpu()
            for name, value in batch["signals"].items():
                entries[f"priorities/{name}"] = value.detach().cpu()
        self._log(entries, run.actions)

    @property
    def shows(self) -> bool:
        """True if pictures are asked for, and there is a log for them."""
        return self._pictures and any(not isinstance(log, CSVLog) for log in self._logs)

    def log_policy(
        self, entries: Mapping[str, Any], *, file: Path, card: Mapping[str, Any], actions: int
    ) -> None:
        """Log pictures and tables of what a policy does, and to wandb the policy."""
        self._log(entries, actions)
        if self._wandb is not None:
            self._wandb.keep(file, card)
        # What cannot be written is missed now, not after the run was reported as finished.
        self.flush()

    def _log(self, entries: Mapping[str, Any], actions: int) -> None:
        for log in self._logs:
            log.log(entries, actions)

    def flush(self) -> None:
        """Write what was logged, so that it survives the end of this process."""
        for log in self._logs:
            log.flush()

    def close(self) -> None:
        """Finish the logs."""
        for log in self._logs:
            log.close()


def log_evaluation(
    run: Path, name: str, table: pd.DataFrame, *, actions: int, picture: Path
) -> str | None:
    """Log an evaluation of a run's policy to the wandb run of its training, if there is one.

    Args:
        run: Folder of the run.
        name: Of the evaluation.
        table: A row for each world, and last the total.
        actions: Those after which the policy was kept.
        picture: The paths; nothing if there is no such file.

    Returns:
        The command that uploads the run, if it is kept offline.
    """
    if not ((run / "wandb").is_dir() and (run / files.CHECKPOINT).exists()):
        return None
    from training.run.wandb_log import WandbLog

    state = read_checkpoint(run)
    settings, total = as_settings(state["settings"]), table.iloc[-1]
    if with_environment(settings.tracking).mode == "off":
        return None
    entries: dict[str, Any] = {f"evaluate/{name}/{rate}": float(total[rate]) for rate in _RATES}
    entries[f"evaluate/{name}/worlds"] = table
    if picture.exists():
        entries[f"evaluate/{name}/paths"] = np.asarray(Image.open(picture))
    log = WandbLog(settings, run, run_id=state["wandb"])
    log.log(entries, actions)
    log.close()
    return upload_command(settings.tracking, run, state["wandb"])


def upload_command(wanted: TrackingSettings, folder: Path, run_id: str) -> str | None:
    """The command line that uploads all parts of an offline run, as one run.

    Examples:
        >>> upload_command(TrackingSettings(mode="offline"), Path("runs/demo"), "1a2b3c4d")
        'wandb sync runs/demo/wandb/offline-run-*-1a2b3c4d'
    """
    if wanted.mode != "offline":
        return None
    return f"wandb sync {shlex.quote(str(folder))}/wandb/offline-run-*-{run_id}"
