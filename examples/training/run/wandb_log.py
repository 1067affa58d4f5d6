"""A run as wandb keeps it: offline by default, online by one setting; all of wandb is here."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import wandb

from training.files import short_name
from training.settings.train import TrainSettings, plain_settings

AXIS = "actions"
"""Axis of every entry: actions of all robots so far."""


_LATE = ("policy/", "evaluate/")
"""Entries that may come after others of the same action: pictures that had been interrupted, and
what ``evaluate.py`` adds."""
BEST = ("evaluation/success", "evaluation/spl")
"""Entries of which the summary keeps the best."""


class WandbLog:
    """A W&B run that keeps its id when training is resumed.

    What a run does again after a checkpoint is logged once: how far it was logged is in a file,
    since wandb does not report it for an offline run.

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
                group=settings.tracking.group or short_name("-".join(parts), 128),
                job_type="train",
                tags=[part[:64] for part in (*parts, settings.regime)],
                mode=settings.tracking.mode,  # type: ignore[arg-type]
                dir=folder,
                config=plain_settings(settings),
                allow_val_change=True,
            )
        except wandb.Error as error:
            raise ValueError(
                f"tracking.mode={settings.tracking.mode}: wandb says {str(error).rstrip('.')}; "
                "tracking=wandb keeps the run on this machine"
            ) from error
        # wandb's own step takes one value of a key, and several episodes may end at one action.
        self._run.define_metric("*", step_metric=AXIS)
        for name in BEST:
            self._run.define_metric(name, step_metric=AXIS, summary="max")
        self._path = folder / "wandb" / f"logged-{run_id}.txt"
        self._path.parent.mkdir(exist_ok=True)
        self._path.touch()
        words = self._path.read_text().split() or (self._run.step, -1)
        self._entries, self._before = map(int, words)
        self._actions = self._before

    def log(self, entries: Mapping[str, Any], actions: int) -> None:
        """Log entries, unless they were logged before the run was stopped."""
        if actions <= self._before and not any(name.startswith(_LATE) for name in entries):
            return
        shown = {name: _as_wandb(value) for name, value in entries.items()}
        self._run.log({**shown, AXIS: actions}, step=self._entries, commit=True)
        self._entries, self._actions = self._entries + 1, max(self._actions, actions)
        # Not emptied first: the new numbers are as long as the old ones, or longer.
        with self._path.open("r+") as file:
            file.write(f"{self._entries} {self._actions}")

    def keep(self, file: Path, card: Mapping[str, Any]) -> None:
        """Keep a policy as an artifact, whose versions are those of runs with the same name."""
        name = re.sub(r"[^\w.-]", "-", f"policy-{file.parent.name}", flags=re.ASCII)
        artifact = wandb.Artifact(short_name(name, 128), type="policy", metadata=dict(card))
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
