"""What a policy does in worlds that it has not met, as a tracker shows it."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from mpfa_envs import Policy, save_policy
from mpfa_envs.evaluation.results import EpisodeResult
from torchrl_mpfa import Learner
from training import files
from training.evaluating import drive
from training.pictures import EPISODE, TRAJECTORIES, VALUES, write_pictures
from training.records import as_table
from training.run.evaluations import SEED
from training.run.tracking import Tracker
from training.run.values import values_of
from training.settings.train import TrainSettings


def show_policy(
    tracker: Tracker,
    settings: TrainSettings,
    policy: Policy,
    learner: Learner,
    *,
    folder: Path,
    actions: int,
) -> float:
    """Log the paths of a policy, an episode, Q over a room, a table of episodes, and the policy.

    Args:
        tracker: Where it is logged; nothing is done unless it shows pictures.
        settings: Of the run; the worlds are those of its evaluations.
        policy: The policy, without noise; it is saved in the folder.
        learner: Whose critic values its actions.
        folder: Of the run.
        actions: Of all robots so far.

    Returns:
        How long it took [s].
    """
    if settings.tracking.pictures_every is None or not tracker.shows:
        return 0.0
    begun, wanted = time.perf_counter(), settings.evaluation
    save_policy(policy, folder / files.POLICY, overwrite=True)
    [drives] = drive(
        policy, [wanted.world], episodes=wanted.episodes, seed=SEED, physics=None, progress=False
    )
    values = values_of(learner, policy, settings)
    with TemporaryDirectory() as place:
        made = Path(place)
        write_pictures(policy, [drives], made, values=values)
        entries: dict[str, Any] = {
            "policy/paths": np.asarray(Image.open(made / TRAJECTORIES)),
            "policy/values": np.asarray(Image.open(made / VALUES)),
            "policy/episode": made / EPISODE,
            "policy/episodes": as_table(drives.results, EpisodeResult),
        }
        card = policy.card
        tracker.log_policy(entries, file=folder / files.POLICY, card=card, actions=actions)
    return time.perf_counter() - begun
