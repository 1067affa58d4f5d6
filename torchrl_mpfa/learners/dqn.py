"""DQN: the policy is the greatest of the values of a few actions."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_mpfa.checks import NOT_NEGATIVE, POSITIVE, SHARE, check
from torchrl_mpfa.learners.optimized import IMPORTANCE, OptimizedLearner
from torchrl_mpfa.losses import distance, read_choices, target_of
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.priorities import td_error_priority
from torchrl_mpfa.selection import Trains
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR

_DISTANCES = ("l1", "l2", "smooth_l1")


def reject_part(trains: Trains, loss_function: str | None, learner: object) -> None:
    """Reject a batch for actor or critic alone, or with a loss function of its own."""
    if trains != "both" or loss_function is not None:
        raise ValueError(
            f"a batch for the {trains} alone, or with the loss function {loss_function!r}, needs "
            f"actor and critic: {type(learner).__name__} has one network for both"
        )


class DQN(OptimizedLearner):
    r"""DQN (Mnih et al. 2015, https://doi.org/10.1038/nature14236), double by default.

    A batch gets ``("signals", "td_error")`` :math:`= |\delta_i|`, shape ``[B]``. There is no signal
    of Eq. (14): a choice among actions has no slope. The loss is Eq. (11),
    :math:`\frac{1}{N} \sum_i w_i (y_i - Q(s_i, a_i))^2`. Actions of a batch are one-hot,
    ``[B, K]``, or numbers, ``[B, 1]``. A batch is for all networks: none for the critic alone.

    Args:
        network: From observations to ``"action_value"`` and a one-hot ``"action"``, such as
            :func:`~torchrl_mpfa.make_value_network` gives. It is held, not copied.
        signals: ``["td_error"]``, or none.
        importance: ``"critic"``: weights divided by the batch size (Eq. 11); ``"torchrl"``: by
            their sum; ``"none"``.
        reward_scale: Factor of the rewards in the loss; the signal is divided by it again.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"``, which bends at an error of one in
            units of the environment's reward.
        double: True to take the next action from the network, and not from the target network
            (van Hasselt et al. 2016, https://arxiv.org/abs/1509.06461).
        gamma: Discount, in [0, 1].
        lr: Learning rate.
        weight_decay: L2 decay of the weights.
        tau: Share of the network in the target network's step.

    Raises:
        TypeError: If the network is no :class:`DirectModule`.
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_value_network
        >>> learner = DQN(make_value_network(24, 7))
        >>> learner.policy.outputs({"observation": torch.rand(5, 24)})["action"].sum(-1).tolist()
        [1, 1, 1, 1, 1]
    """

    def __init__(
        self,
        network: DirectModule,
        *,
        signals: Sequence[str] = (TD_ERROR.name,),
        importance: str = "critic",
        reward_scale: float = 1.0,
        loss_function: str = "l2",
        double: bool = True,
        gamma: float = 0.99,
        lr: float = 1e-4,
        weight_decay: float = 0.0,
        tau: float = 0.01,
    ) -> None:
        if not isinstance(network, DirectModule):
            raise TypeError(f"network must be a DirectModule, got {type(network).__name__}")
        for name in signals:
            if name == ACTION_GRADIENT.name:
                raise ValueError(
                    f"signals must not have {name!r}: values of separate actions have no slope. "
                    "Leave it out, as with signals=['reward', 'td_error']"
                )
            if name != TD_ERROR.name:
                raise ValueError(f"signals must be among ['td_error'], got {name!r}")
        if loss_function not in _DISTANCES:
            raise ValueError(f"loss_function must be one of {_DISTANCES}, got {loss_function!r}")
        self.signals, self.loss_function, self.double = tuple(signals), loss_function, double
        self.importance = check(IMPORTANCE, importance=importance)
        self.reward_scale, lr = check(POSITIVE, reward_scale=reward_scale, lr=lr)
        self.gamma = check(SHARE, gamma=gamma)
        decay = check(NOT_NEGATIVE, weight_decay=weight_decay)
        groups = [{"params": [*network.parameters()], "lr": lr, "weight_decay": decay}]
        target = copy.deepcopy(network).requires_grad_(False)
        networks, targets = nn.ModuleDict({"value": network}), nn.ModuleDict({"value": target})
        super().__init__(networks, targets, groups, tau)
        self.policy: DirectModule = network

    def _differentiate(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        reject_part(trains, loss_function, self)
        online, target = self.policy, self.targets["value"]
        states, after = self._states_of(batch), self._states_of(batch["next"])
        values = online.outputs(states)["action_value"]
        number = read_choices(batch["action"], values.shape[-1], batch)
        value = values.gather(-1, number.unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            choice = (online if self.double else target).outputs(after)["action"]
            ahead = (target.outputs(after)["action_value"] * choice).sum(-1)
            aim = target_of(batch, ahead, gamma=self.gamma, reward_scale=self.reward_scale)
        losses = distance(value, aim, self.loss_function, unit=self.reward_scale)  # Eq. (4)
        weight = batch.get("priority_weight", None)
        if weight is not None and self.importance != "none":
            weight = weight.reshape(-1)
            losses = losses * weight / (weight.mean() if self.importance == "torchrl" else 1.0)
        loss = losses.mean()  # Eq. (11)
        loss.backward()
        error = (aim - value).detach()
        if self.signals:
            batch.set(TD_ERROR.key, td_error_priority(error) / self.reward_scale)  # Eq. (13)
        return {"loss_value": loss.detach(), "td_error": error.square()}

    def _states_of(self, source: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Read the inputs of the network, without gradients."""
        return {key: source[key].detach() for key in self.policy.in_keys}
