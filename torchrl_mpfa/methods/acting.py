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
    """Actions of a policy without exploration, on the device of the batch, which may be another.

    Args:
        policy: The policy; reads what its ``in_keys`` name, writes the action.
        batch: Transitions with their own actions, batch size ``[B]``.
        action_key: Key of the action.

    Returns:
        Actions, shape ``[B, A]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_mpfa import make_actor
        >>> seen = TensorDict({"observation": torch.rand(8, 24), "action": torch.rand(8, 2)}, [8])
        >>> actions_of(make_actor(24, 2), seen).shape
        torch.Size([8, 2])
    """
    read = batch.select(*policy.in_keys)
    parameter = next(policy.parameters(), None)
    if parameter is not None:
        read = read.to(parameter.device)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action: Tensor = policy(read)[action_key]
    return action.to(batch[action_key].device)
