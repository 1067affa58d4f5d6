"""TorchRL's loggers in the folder of a run, each of which goes on with its log when a run resumes.

A resumed run logs again what was logged after its checkpoint. Of a CSV file those rows are removed,
TensorBoard hides them, and wandb does not get them.
"""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Mapping
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from PIL import Image
from torchrl.record import CSVLogger, TensorboardLogger, WandbLogger

from training import files
from training.settings.train import TrainSettings, plain_settings

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

AXIS = "actions"
"""Axis of every entry in wandb: actions of all robots so far."""
BEST = ("evaluation/success", "evaluation/spl")
"""Entries of which the summary of wandb keeps the best."""
_LATE = ("policy/", "evaluate/")
"""Entries that may come after others of the same action: pictures that had been interrupted, and
what ``evaluate.py`` adds."""


class CSVLog(CSVLogger):
    """Numbers in ``csv/scalars/NAME.csv``, rows of actions and value.

    Args:
        folder: Of the run.
        actions: Actions after which the run resumes; 0: it begins.
    """

    def __init__(self, folder: Path, *, actions: int) -> None:
        for path in (folder / files.CSV).rglob("*.csv"):
            forget_after(actions, path)
        super().__init__(files.CSV, log_dir=str(folder))

    def log(self, entries: Mapping[str, Any], actions: int) -> None:
        """Log the numbers."""
        self.log_metrics(_numbers(entries), step=actions)

    def close(self, timeout: float | None = None) -> None:
        """Close the files; of a row that had no room, nothing stays."""
        for path, file in self.experiment.files.items():
            try:
                file.close()
            except OSError:  # It was raised as the row was logged.
                forget_after(math.inf, Path(path))


def forget_after(actions: float, path: Path) -> None:
    """Remove the rows of a CSV file that were logged after so many actions, and half a row.

    They are the last ones. The file is cut in one step, for which a full disk has room; a file
    without a row is removed.
    """

    def is_kept(row: bytes) -> bool:
        return row.endswith(b"\n") and int(row.partition(b",")[0]) <= actions

    rows = path.read_bytes().splitlines(keepends=True)
    if size := sum(map(len, takewhile(is_kept, rows))):
        os.truncate(path, size)
    else:
        path.unlink()


class TensorboardLog(TensorboardLogger):
    """Numbers, histograms and pictures in ``tensorboard/``.

    Args:
        folder: Of the run.
        actions: Actions after which the run resumes; 0: it begins.
        settings: Of the run, by their dotted names.
    """

    def __init__(self, folder: Path, *, actions: int, settings: Mapping[str, Any]) -> None:
        self._purge_step = actions + 1
        super().__init__(files.TENSORBOARD, log_dir=str(folder))
        add_settings(self.experiment, settings, actions)

    def _create_experiment(self) -> SummaryWriter:
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(f"{self.log_dir}/{self.exp_name}", purge_step=self._purge_step)

    def log(self, entries: Mapping[str, Any], actions: int) -> None:
        """Log what is no table."""
        self.log_metrics(_numbers(entries), step=actions)
        for name, value in entries.items():
            if isinstance(value, torch.Tensor):
                self.log_histogram(name, value, step=actions, bins="tensorflow")
            elif isinstance(value, np.ndarray):
                self.experiment.add_image(name, value, actions, dataformats="HWC")
            elif isinstance(value, Path):
                add_gif(self.experiment, name, value, actions)


def _numbers(entries: Mapping[str, Any]) -> dict[str, float]:
    return {name: value for name, value in entries.items() if isinstance(value, int | float)}


def add_settings(writer: SummaryWriter, settings: Mapping[str, Any], actions: int) -> None:
    """Log settings as a text, and as hyperparameters of the success in evaluations."""
    from torch.utils.tensorboard.summary import hparams

    lines = [f"| {name} | {value} |" for name, value in settings.items()]
    writer.add_text("settings", "\n".join(["| setting | value |", "|---|---|", *lines]), actions)
    plain = {
        name: value if isinstance(value, bool | int | float | str) else str(value)
        for name, value in settings.items()
    }
    for summary in hparams(plain, {"evaluation/success": 0.0}):
        writer._get_file_writer().add_summary(summary)


def add_gif(writer: SummaryWriter, name: str, path: Path, actions: int) -> None:
    """Log an animation as a picture that moves, for which ``add_video`` would need MoviePy."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    content = path.read_bytes()
    width, height = Image.open(io.BytesIO(content)).size
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=content)
    summary = Summary(value=[Summary.Value(tag=name, image=image)])
    writer._get_file_writer().add_summary(summary, actions)


class WandbLog(WandbLogger):
    """A W&B run that keeps its id when training is resumed.

    How far the run was logged is in a file, since wandb does not report it for an offline run.

    Args:
        settings: Of the run, its configuration.
        folder: Of the run, where wandb keeps it.
        run_id: Of the run.
    """

    def __init__(self, settings: TrainSettings, folder: Path, *, run_id: str) -> None:
        # Imported here, and below, as it takes a second, and a run without wandb need not wait.
        import wandb

        os.environ.setdefault("WANDB_SILENT", "true")
        parts = [settings.curriculum.name or "", settings.method.name, settings.learner.name]
        try:
            super().__init__(
                folder.name,
                save_dir=folder,
                id=run_id,
                project=settings.tracking.project,
                log_env_packages=False,
                mode=settings.tracking.mode,
                group=settings.tracking.group or files.short_name("-".join(parts), 128),
                job_type="train",
                tags=[part[:64] for part in (*parts, settings.regime)],
                config=plain_settings(settings),
                allow_val_change=True,
            )
        except wandb.Error as error:
            raise ValueError(
                f"tracking.mode={settings.tracking.mode}: wandb says {str(error).rstrip('.')}; "
                "tracking=wandb keeps the run on this machine"
            ) from error
        # wandb's own step takes one value of a key, and several episodes may end at one action.
        self.experiment.define_metric("*", step_metric=AXIS)
        for name in BEST:
            self.experiment.define_metric(name, step_metric=AXIS, summary="max")
        self._path = folder / "wandb" / f"logged-{run_id}.txt"
        self._path.parent.mkdir(exist_ok=True)
        self._path.touch()
        counts = self._path.read_text().split() or (self.experiment.step, -1)
        self._entries, self._before = map(int, counts)
        self._actions = self._before

    def log(self, entries: Mapping[str, Any], actions: int) -> None:
        """Log entries, unless they were logged before the run was stopped."""
        if actions <= self._before and not any(name.startswith(_LATE) for name in entries):
            return
        shown = {name: _as_wandb(value) for name, value in entries.items()}
        self.experiment.log({**shown, AXIS: actions}, step=self._entries, commit=True)
        self._entries, self._actions = self._entries + 1, max(self._actions, actions)
        # Not emptied first: the new numbers are as long as the old ones, or longer.
        with self._path.open("r+") as file:
            file.write(f"{self._entries} {self._actions}")

    def keep(self, file: Path, card: Mapping[str, Any]) -> None:
        """Keep a policy as an artifact, whose versions are those of runs with the same name."""
        import wandb

        name = re.sub(r"[^\w.-]", "-", f"policy-{file.parent.name}", flags=re.ASCII)
        artifact = wandb.Artifact(files.short_name(name, 128), type="policy", metadata=dict(card))
        artifact.add_file(str(file))
        self.experiment.log_artifact(artifact)


def _as_wandb(value: Any) -> Any:
    import wandb

    if isinstance(value, torch.Tensor):
        return wandb.Histogram(np.asarray(value))
    if isinstance(value, np.ndarray):
        return wandb.Image(value)
    if isinstance(value, pd.DataFrame):
        return wandb.Table(dataframe=value)
    if isinstance(value, Path):
        return wandb.Video(str(value), format="gif")
    return value


Log = CSVLog | TensorboardLog | WandbLog
"""A log of entries: numbers, tensors (for a histogram), pictures ``[height, width, 3]``, files of
GIFs and tables. What a kind of log cannot hold is left out."""
