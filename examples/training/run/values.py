"""Values of observations by the critic of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from mpfa_envs import Policy
from torchrl_mpfa import ActorCritic, Learner
from training.pictures import Values
from training.run.assembly import make_learner, method_of
from training.run.checkpoints import read_checkpoint
from training.settings.train import TrainSettings, as_settings


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


def values_of(learner: Learner, policy: Policy, settings: TrainSettings) -> Values:
    """Return a function that values a policy's actions by the critics of a learner.

    Args:
        learner: The learner; its networks are used as they are when the values are asked for.
        policy: Whose actions are valued; a learner without an actor values its own.
        settings: Of the run.

    Returns:
        The values, in units of the reward.
    """
    device = settings.device
    scale = settings.learner.reward_scale

    def worth(observations: NDArray[np.float32]) -> NDArray[np.float64]:
        seen = {"observation": torch.as_tensor(observations, device=device)}
        with torch.no_grad():
            if isinstance(learner, ActorCritic):
                seen["action"] = torch.as_tensor(policy(observations), device=device)
                best = learner.values_of(TensorDict(seen, [len(observations)])).amin(0)
            else:
                best = learner.policy.outputs(seen)["chosen_action_value"].squeeze(-1)
        return best.double().cpu().numpy() / scale

    return worth
