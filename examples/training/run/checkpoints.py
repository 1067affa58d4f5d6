"""Checkpoints: how they are read, and the learner in them."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch

from mpfa_envs import Policy
from torchrl_mpfa import Learner
from torchrl_mpfa.saving import load_safely
from training import files
from training.run.assembly import make_learner, method_of
from training.settings.train import TrainSettings, as_settings

FORMAT = 7
"""7: networks and targets of a learner; 5: many robots, in the middle of their episodes."""


def is_sound(learner: Learner) -> bool:
    """Return True if all parameters are finite, as a learner that can be saved has them."""
    try:
        learner.state_dict()
    except ValueError:
        return False
    return True


def read_checkpoint(folder: Path) -> dict[str, Any]:
    """Read a run's checkpoint without executing anything in it."""
    file = folder / files.CHECKPOINT
    if not file.exists():
        raise FileNotFoundError(f"resume: there is no {files.CHECKPOINT} in {folder}")
    try:
        state: Any = load_safely(file)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        raise ValueError(f"{file} is damaged or not a checkpoint") from error
    found = state.get("format") if isinstance(state, dict) else None
    if found != FORMAT:
        raise ValueError(f"{file} has format {found}, this version reads {FORMAT}")
    return dict(state)


def load_learner(folder: Path, policy: Policy) -> tuple[Learner, TrainSettings]:
    """Read the learner of a run, with its critic.

    Args:
        folder: Of the run, with its checkpoint.
        policy: That of the run.

    Returns:
        The learner, which is not compiled, and the settings of the run.

    Raises:
        FileNotFoundError: If there is no checkpoint.
        ValueError: If it is damaged, of another version, or its learner is of another policy.
    """
    state = read_checkpoint(folder)
    settings = as_settings(state["settings"])
    settings.device = "cpu"
    sizes = policy.observation_size, policy.action_size
    learner = make_learner(settings.learner, method_of(settings), *sizes)
    learner.load_state_dict(state["learner"])
    return learner, settings


def random_state(device: str) -> Any:
    """Return the state of PyTorch's random numbers."""
    if torch.device(device).type != "cuda":
        return torch.get_rng_state()
    return {"cpu": torch.get_rng_state(), "cuda": torch.cuda.get_rng_state(device)}


def set_random_state(device: str, state: Any) -> None:
    """Restore what :func:`random_state` returned."""
    if not isinstance(state, dict):
        state = {"cpu": state}
    torch.set_rng_state(state["cpu"])
    if "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)
