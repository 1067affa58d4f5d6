"""Actions of the current policy at the observations of stored transitions."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type


def actions_of(
    policy: TensorDictModule, batch: TensorDictBase, *, action_key: NestedKey = "action"
) -> Tensor:
    """Actions ``[B, A]`` of a policy without exploration, which must be those of the batch in form.

    They are on the device of the batch.
    """
    read = batch.select(*policy.in_keys)
    parameter = next(policy.parameters(), None)
    if parameter is not None:
        read = read.to(parameter.device)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action: Tensor = policy(read)[action_key]
    stored: Tensor = batch[action_key]
    if stored.shape != action.shape:
        raise ValueError(
            f"{action_key!r} must have the shape of the policy's actions, {[*action.shape]}, got "
            f"{[*stored.shape]}"
        )
    return action.to(stored.device)
