"""Files that a run saves: its checkpoint, its policy and its records."""

from __future__ import annotations

import copy
import pickle
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from mpfa_envs import Policy, save_policy
from torchrl_mpfa import Learner
from torchrl_mpfa.saving import load_safely, save_atomically
from training import files
from training.records import EpisodeRecord, EvaluationRecord, as_table, write_table
from training.run.assembly import make_learner, method_of
from training.run.evaluations import kept_policy
from training.run.hooks import Hook
from training.settings.train import TrainSettings, as_settings

if TYPE_CHECKING:
    from training.run.loop import TrainingRun

FORMAT = 7
"""7: networks and targets of a learner; 5: many robots, in the middle of their episodes."""


class Checkpoints(Hook):
    """Saves the run every ``checkpoint_every`` actions and at its end."""

    def on_iteration(self, run: TrainingRun) -> None:
        """Save if it is due."""
        if run.crossed(run.settings.checkpoint_every):
            save(run)

    def on_end(self, run: TrainingRun) -> None:
        """Save."""
        save(run)


def save(run: TrainingRun) -> None:
    """Write checkpoint, policy and records, each of them whole or not at all."""
    folder = run.folder
    # A run that resumes here does not log the same entries again.
    run.tracker.flush()
    save_atomically(state_of(run), folder / files.CHECKPOINT)
    save_policy(kept_policy(run), folder / files.POLICY, overwrite=True)
    write_table(as_table(run.records, EpisodeRecord), folder / files.EPISODES)
    if run.evaluations:
        write_table(as_table(run.evaluations, EvaluationRecord), folder / files.EVALUATIONS)
    write_table(run.log.table(), folder / files.UPDATES)


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


def state_of(run: TrainingRun) -> dict[str, Any]:
    """Return everything that the next iteration of a run depends on, and its records."""
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
        "curiosity": None if run.bonus is None else run.bonus.checkpoint(),
        "signals": run.signals.state_dict(),
        "plugin": files.digest_of(run.settings.plugin),
        "best": None if run.best is None else dict(run.best.state_dict()),
        "records": [asdict(record) for record in run.records],
        "evaluations": [asdict(record) for record in run.evaluations],
        "log": run.log.state_dict(),
    }


def restore(run: TrainingRun, state: dict[str, Any]) -> None:
    """Load a state into a run, but for the robots: these may begin new episodes."""
    run.schedule.load_state_dict(state["schedule"])
    run.updates = state["updates"]
    run.waiting = state["waiting"] * run.settings.robots
    run.waiting += state["waiting_actions"]
    run.learner.load_state_dict(state["learner"])
    run.buffer.load_state_dict(state["buffer"])
    run.explorer.load_state_dict(state["explorer"])
    if run.bonus is not None:
        run.bonus.restore(state["curiosity"])
    run.signals.load_state_dict(state["signals"])
    if state["best"] is not None:
        run.best = copy.deepcopy(run.learner.policy)
        run.best.load_state_dict(state["best"])
    run.records = [EpisodeRecord(**record) for record in state["records"]]
    run.evaluations = [EvaluationRecord(**record) for record in state["evaluations"]]
    run.log.load_state_dict(state["log"])
    set_random_state(run.settings.device, state["random"])


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
