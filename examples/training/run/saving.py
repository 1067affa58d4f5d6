"""The hook that saves a run: its checkpoint, its policy, its records."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpfa_envs import save_policy
from torchrl_mpfa import Learner
from torchrl_mpfa.files import save_atomically
from training import files
from training.records import (
    EpisodeRecord,
    EvaluationRecord,
    as_table,
    write_table,
)
from training.run.checkpoints import state_of
from training.run.evaluations import kept_policy
from training.run.hooks import Hook

if TYPE_CHECKING:
    from training.run.loop import TrainingRun


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
    # What was logged until now is not logged again by a run that goes on from here.
    run.tracker.flush()
    save_atomically(state_of(run), folder / files.CHECKPOINT)
    save_policy(kept_policy(run), folder / files.POLICY, overwrite=True)
    write_table(as_table(run.records, EpisodeRecord), folder / files.EPISODES)
    if run.evaluations:
        write_table(as_table(run.evaluations, EvaluationRecord), folder / files.EVALUATIONS)
    write_table(run.log.table(), folder / files.UPDATES)


def is_sound(learner: Learner) -> bool:
    """Whether an error has left the networks as numbers."""
    return all(bool(value.isfinite().all()) for value in learner.state_dict()["loss"].values())
