"""The checkpoint of a run: everything that its next iteration depends on."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchrl_mpfa.files import load_safely
from training.files import CHECKPOINT
from training.records import EpisodeRecord, EvaluationRecord

if TYPE_CHECKING:
    from training.run.loop import TrainingRun

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


def state_of(run: TrainingRun) -> dict[str, Any]:
    """A run's state: everything that its next iteration depends on, and its records."""
    return {
        "format": FORMAT,
        "settings": asdict(run.settings),
        "wandb": run.tracker.run_id,
        "schedule": run.schedule.state_dict(),
        "updates": run.updates,
        "waiting": run.waiting // run.settings.robots,
        "waiting_actions": run.waiting % run.settings.robots,
        "random": random_state(run.settings.device),
        "robots": run.robots.state_dict(),
        "learner": run.learner.state_dict(),
        "buffer": run.buffer.state_dict(),
        "explorer": run.explorer.state_dict(),
        "curiosity": None if run.curiosity is None else run.curiosity.checkpoint(),
        "best": None if run.best is None else dict(run.best.state_dict()),
        "records": [asdict(record) for record in run.records],
        "evaluations": [asdict(record) for record in run.evaluations],
        "log": run.log.state_dict(),
    }


def restore(run: TrainingRun, state: dict[str, Any]) -> None:
    """Take over everything but where the robots are, which depends on how they go on."""
    run.schedule.load_state_dict(state["schedule"])
    run.updates = state["updates"]
    run.waiting = state.get("waiting", 0) * run.settings.robots
    run.waiting += state.get("waiting_actions", 0)
    run.learner.load_state_dict(state["learner"])
    run.buffer.load_state_dict(state["buffer"])
    run.explorer.load_state_dict(state["explorer"])
    if run.curiosity is not None:
        run.curiosity.restore(state["curiosity"])
    if state["best"] is not None:
        run.best = copy.deepcopy(run.learner.policy)
        run.best.load_state_dict(state["best"])
    run.records = [EpisodeRecord(**record) for record in state["records"]]
    run.evaluations = [EvaluationRecord(**record) for record in state["evaluations"]]
    if "log" in state:  # A checkpoint may be older than the rows.
        run.log.load_state_dict(state["log"])
    set_random_state(run.settings.device, state["random"])


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
