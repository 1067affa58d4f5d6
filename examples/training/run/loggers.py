"""TorchRL's loggers that write to the folder of a run; a resumed run begins no second log.

A resumed run logs again what was logged after its checkpoint. Of a CSV file those
rows are removed, and TensorBoard hides them.
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Mapping
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from training import files

Entry = float | torch.Tensor | NDArray[np.uint8] | Path
"""A number, values for a histogram, a picture ``[height, width, 3]``, or the file of a GIF."""


class Log(Protocol):
    """A log of entries."""

    def log(self, entries: Mapping[str, Any], actions: int) -> None:
        """Log entries by their names; what this kind of log cannot hold is left out."""

    def flush(self) -> None:
        """Write what was logged, so that it survives the end of this process."""

    def close(self) -> None:
        """Finish the log."""


class CSVLog:
    """Numbers in ``csv/scalars/NAME.csv``, rows of actions and value.

    Args:
        folder: Of the run.
        actions: Actions after which the run resumes; 0: it begins.
    """

    def __init__(self, folder: Path, *, actions: int) -> None:
        self._folder, self._actions = folder, actions

    @cached_property
    def _logger(self) -> Any:
        # Only now: an earlier log in the folder has been moved to ``previous/``.
        from torchrl.record import CSVLogger

        for path in (self._folder / files.CSV).rglob("*.csv"):
            forget_after(self._actions, path)
        return CSVLogger(files.CSV, log_dir=str(self._folder))

    def log(self, entries: Mapping[str, Any], actions: int) -> None:
        """Log the numbers."""
        for name, value in entries.items():
            if isinstance(value, int | float):
                self._logger.log_scalar(name, value, step=actions)

    def flush(self) -> None:
        """Do nothing: the logger does so after every row."""

    def close(self) -> None:
        """Close the files, if there are any; of a row that had no room, nothing stays."""
        if "_logger" in vars(self):
            for path, file in self._logger.experiment.files.items():
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


class TensorboardLog:
    """Numbers, histograms and pictures in ``tensorboard/``.

    Args:
        folder: Of the run.
        actions: Actions after which the run resumes; 0: it begins.
        settings: Of the run, by their dotted names.
    """

    def __init__(self, folder: Path, *, actions: int, settings: Mapping[str, Any]) -> None:
        self._folder, self._actions, self._settings = folder, actions, settings

    @cached_property
    def _logger(self) -> Any:
        # Only now: an earlier log in the folder has been moved to ``previous/``.
        from torch.utils.tensorboard import SummaryWriter
        from torchrl.record import TensorboardLogger

        class Continued(TensorboardLogger):
            """TorchRL's, which hides what came after the checkpoint."""

            def _create_experiment(this) -> SummaryWriter:
                folder = self._folder / files.TENSORBOARD
                return SummaryWriter(str(folder), purge_step=self._actions + 1)

        made = Continued(files.TENSORBOARD, log_dir=str(self._folder))
        add_settings(made.experiment, self._settings, self._actions)
        return made

    def log(self, entries: Mapping[str, Any], actions: int) -> None:
        """Log what is no table."""
        writer = self._logger.experiment
        for name, value in entries.items():
            if isinstance(value, int | float):
                self._logger.log_scalar(name, value, step=actions)
            elif isinstance(value, torch.Tensor):
                self._logger.log_histogram(name, value, step=actions, bins="tensorflow")
            elif isinstance(value, np.ndarray):
                writer.add_image(name, value, actions, dataformats="HWC")
            elif isinstance(value, Path):
                add_gif(writer, name, value, actions)

    def flush(self) -> None:
        """Write what waits to be written."""
        if "_logger" in vars(self):
            self._logger.experiment.flush()

    def close(self) -> None:
        """Close the files, if there are any."""
        if "_logger" in vars(self):
            self._logger.experiment.close()


def add_settings(writer: Any, settings: Mapping[str, Any], actions: int) -> None:
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


def add_gif(writer: Any, name: str, path: Path, actions: int) -> None:
    """Log an animation as a picture that moves, for which ``add_video`` would need MoviePy."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    content = path.read_bytes()
    width, height = Image.open(io.BytesIO(content)).size
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=content)
    summary = Summary(value=[Summary.Value(tag=name, image=image)])
    writer._get_file_writer().add_summary(summary, actions)
