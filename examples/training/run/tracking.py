"""What of a run goes to its logs, and when: numbers, and pictures of its policy."""

from __future__ import annotations

import os
import secrets
import shlex
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from PIL import Image
from tensordict import TensorDictBase

from mpfa_envs import save_policy
from mpfa_envs.evaluation.results import EpisodeResult
from training import files
from training.evaluating import as_trained, drive
from training.inherited import with_environment
from training.pictures import EPISODE, TRAJECTORIES, VALUES, trajectories_of, write_pictures
from training.records import EpisodeRecord, EvaluationRecord, as_table
from training.run.checkpoints import read_checkpoint
from training.run.evaluations import SEED, kept_policy, values_of
from training.run.hooks import Hook
from training.run.loggers import CSVLog, Log, TensorboardLog, WandbLog
from training.settings.rules import settings_by_name
from training.settings.train import TrackingSettings, TrainSettings, as_settings

if TYPE_CHECKING:
    from training.run.loop import TrainingRun


_RATES = ("success", "collision", "timeout", "spl", "sct")
"""Numbers of an evaluation."""
_SMALL = 240
"""Width of a world in pictures during the training [px]; they take 0.1 s each."""


class Tracker(Hook):
    """The logs of a run; every name is explained in ``docs/metrics.md``.

    Args:
        settings: The settings, logged as the run's configuration.
        folder: Of the run, where wandb's log is kept.
        run_id: wandb's id of a run that resumes; it stays one run.
    """

    def __init__(self, settings: TrainSettings, folder: Path, *, run_id: str | None) -> None:
        # A sweep has given its run an id.
        self.run_id = run_id or os.environ.get("WANDB_RUN_ID") or secrets.token_hex(4)
        self._wanted = with_environment(settings.tracking)
        self.upload = upload_command(self._wanted, folder, self.run_id)
        """Command that uploads the run to wandb, if it is kept offline."""
        has_pictures = self._wanted.mode != "off" or self._wanted.tensorboard
        self.shows = has_pictures and self._wanted.pictures_every is not None
        """True if pictures are asked for, and there is a log for them."""
        self._wandb: WandbLog | None = None
        self._logs: list[Log] = []
        # Now, as wandb may reject the run; the files of the others once the run begins.
        if self._wanted.mode != "off":
            self._wandb = WandbLog(settings, folder, run_id=self.run_id)
            self._logs.append(self._wandb)

    def on_begin(self, run: TrainingRun) -> None:
        """Open the files; those of an earlier run in the folder have been moved by now."""
        if self._wanted.csv:
            self._logs.append(CSVLog(run.folder, actions=run.actions))
        if self._wanted.tensorboard:
            settings = dict(settings_by_name(run.settings))
            self._logs.append(TensorboardLog(run.folder, actions=run.actions, settings=settings))

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
        self.log(entries, record.total_steps)

    def on_evaluation(self, run: TrainingRun, record: EvaluationRecord) -> None:
        """Log an evaluation, with a picture of its paths where a log can show it."""
        entries: dict[str, Any] = {f"evaluation/{name}": getattr(record, name) for name in _RATES}
        if self.shows and run.driven is not None:
            entries["evaluation/paths"] = trajectories_of([run.driven], size=_SMALL)
        self.log(entries, record.total_steps)

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
        self.log(entries, run.actions)

    def log(self, entries: Mapping[str, Any], actions: int) -> None:
        """Log entries by their names."""
        for log in self._logs:
            log.log(entries, actions)

    def keep(self, file: Path, card: Mapping[str, Any]) -> None:
        """Keep a policy in wandb, if the run has a log there."""
        if self._wandb is not None:
            self._wandb.keep(file, card)

    def flush(self) -> None:
        """Write what was logged, so that it survives the end of this process."""
        for log in self._logs:
            log.flush()

    def close(self) -> None:
        """Finish the logs."""
        for log in self._logs:
            log.close()


class Pictures(Hook):
    """Shows the policy of a finished run, before the run is reported as finished.

    So a run whose pictures were interrupted makes them when it is resumed.
    """

    def on_end(self, run: TrainingRun) -> None:
        """Show the policy."""
        if run.schedule.finished:
            show_policy(run)


def show_policy(run: TrainingRun) -> None:
    """Log the paths of a run's policy, an episode, Q over a room, a table of episodes, the policy.

    The worlds are those of the run's evaluations. Nothing is done unless pictures are asked for
    and a log can show them. The clock of the run, which shows how long it trains, stands still.
    """
    if not run.tracker.shows:
        return
    settings = run.settings
    begun, wanted, policy = time.perf_counter(), settings.evaluation, kept_policy(run)
    file = run.folder / files.POLICY
    save_policy(policy, file, overwrite=True)
    driver = as_trained(policy)
    [drives] = drive(
        driver, [wanted.world], episodes=wanted.episodes, seed=SEED, physics=None, progress=False
    )
    values = values_of(run.learner, policy, settings)
    with TemporaryDirectory() as place:
        pictures = Path(place)
        write_pictures(driver, [drives], pictures, values=values)
        entries: dict[str, Any] = {
            "policy/paths": np.asarray(Image.open(pictures / TRAJECTORIES)),
            "policy/values": np.asarray(Image.open(pictures / VALUES)),
            "policy/episode": pictures / EPISODE,
            "policy/episodes": as_table(drives.results, EpisodeResult),
        }
        run.tracker.log(entries, run.actions)
        run.tracker.keep(file, policy.card)
        # What cannot be written is missed now, not after the run was reported as finished.
        run.tracker.flush()
    run.robots.seconds -= time.perf_counter() - begun


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
