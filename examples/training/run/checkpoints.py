"""The checkpoint of a run: everything that its next iteration depends on."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_mpfa.saving import load_safely
from training.files import CHECKPOINT

FORMAT = 5
"""5: many robots, in the middle of their episodes."""


def read_checkpoint(folder: Path) -> dict[str, Any]:
    """Read a run's checkpoint without executing anything in it."""
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


def random_state(device: str) -> Any:
    """Where PyTorch's random numbers are."""
    if torch.device(device).type != "cuda":
        return torch.get_rng_state()
    return {"cpu": torch.get_rng_state(), "cuda": torch.cuda.get_rng_state(device)}


def set_random_state(device: str, state: Any) -> None:
    """Go on where :func:`random_state` was called."""
    if not isinstance(state, dict):
        state = {"cpu": state}
    torch.set_rng_state(state["cpu"])
    if "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)


def as_tensors(value: Any) -> Any:
    """A state with tensors in place of NumPy's arrays, which a safe loader takes for code."""
    return _replaced(value, np.ndarray, torch.from_numpy)


def as_arrays(value: Any) -> Any:
    """What :func:`as_tensors` was given."""
    return _replaced(value, torch.Tensor, torch.Tensor.numpy)


def _replaced(value: Any, kind: type[Any], convert: Callable[[Any], Any]) -> Any:
    if isinstance(value, kind):
        return convert(value)
    if isinstance(value, dict):
        return {name: _replaced(each, kind, convert) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_replaced(each, kind, convert) for each in value]
    return value
