"""Pictures of a run's policy in unseen worlds, for its tracker."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from mpfa_envs import save_policy
from mpfa_envs.evaluation.results import EpisodeResult
from training import files
from training.evaluating import as_trained, drive
from training.pictures import EPISODE, TRAJECTORIES, VALUES, write_pictures
from training.records import as_table
from training.run.evaluations import SEED, kept_policy
from training.run.hooks import Hook
from training.run.values import values_of

if TYPE_CHECKING:
    from training.run.loop import TrainingRun


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
        made = Path(place)
        write_pictures(driver, [drives], made, values=values)
        entries: dict[str, Any] = {
            "policy/paths": np.asarray(Image.open(made / TRAJECTORIES)),
            "policy/values": np.asarray(Image.open(made / VALUES)),
            "policy/episode": made / EPISODE,
            "policy/episodes": as_table(drives.results, EpisodeResult),
        }
        run.tracker.log_policy(entries, file=file, card=policy.card, actions=run.actions)
    run.robots.seconds -= time.perf_counter() - begun
