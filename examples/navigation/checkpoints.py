"""The checkpoint of a run: everything that its next episode depends on."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

from navigation.files import CHECKPOINT
from torchrl_mpfa import load_safely

FORMAT = 4
"""4: settings of one process; a wandb run's id; ``timeout`` and ``evaluations``."""


def read_checkpoint(folder: Path) -> dict[str, Any]:
    """Read a run's checkpoint without executing anything in it.

    Args:
        folder: The folder of the run.

    Returns:
        What :meth:`navigation.training.TrainingRun.save` wrote.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is damaged, or another version wrote it.
    """
    file = folder / CHECKPOINT
    if not file.exists():
        raise FileNotFoundError(f"resume: there is no {CHECKPOINT} in {folder}")
    try:
        state: Any = load_safely(file)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        raise ValueError(f"{file} is damaged or not a checkpoint") from error
    found = state.get("format") if isinstance(state, dict) else None
    if found != FORMAT:
        raise ValueError(f"{file} has format {found}, this version reads {FORMAT}")
    return dict(state)
