"""DQN loss that writes the TD error of each transition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import DQNLoss, ValueEstimators

from torchrl_mpfa.checks import POSITIVE, SHARE, check
from torchrl_mpfa.losses.base import IMPORTANCE
from torchrl_mpfa.losses.functional import distance, estimated_target, read_choices
from torchrl_mpfa.losses.stacked import Function, HoldsNetworks, as_function, bind
from torchrl_mpfa.priorities import td_error_priority
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR

_DISTANCES = ("l1", "l2", "smooth_l1")


class SignalDQNLoss(HoldsNetworks, DQNLoss):
    r""":class:`~torchrl.objectives.DQNLoss` that also writes the signal of Eq. (13).

    A batch gets ``("signals", "td_error")`` :math:`= |\delta_i|`, shape ``[B]``. There is no signal
    of Eq. (14): a choice among actions has no slope. The loss is Eq. (11),
    :math:`\frac{1}{N} \sum_i w_i (y_i - Q(s_i, a_i))^2`.

    Args:
        value_network: From observations to ``"action_value"``, ``"chosen_action_value"`` and a
            one-hot ``"action"``, such as :func:`~torchrl_mpfa.make_value_network` gives.
        signals: ``["td_error"]``, or none.
        importance: ``"critic"``: weights divided by the batch size (Eq. 11); ``"torchrl"``: by
            their sum; ``"none"``.
        reward_scale: Factor of the rewards in the loss; the signal is divided by it again.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"``, which bends at an error of one in
            units of the environment's reward.
        double: True to take the next action from the network, and not from the target network
            (van Hasselt et al. 2016, https://arxiv.org/abs/1509.06461).
        gamma: Discount, in [0, 1].

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_value_network
        >>> SignalDQNLoss(make_value_network(24, 7)).double_dqn
        True
    """

    SIGNALS: ClassVar[tuple[str, ...]] = (TD_ERROR.name,)
    _bound: tuple[Function, Function] | None

    def __init__(
        self,
        value_network: TensorDictModule,
        *,
        signals: Sequence[str] = SIGNALS,
        importance: str = "critic",
        reward_scale: float = 1.0,
        loss_function: str = "l2",
        double: bool = True,
        gamma: float = 0.99,
    ) -> None:
        _check_signals(signals)
        check(IMPORTANCE, importance=importance)
        if loss_function not in _DISTANCES:
            raise ValueError(f"loss_function must be one of {_DISTANCES}, got {loss_function!r}")
        reward_scale = check(POSITIVE, reward_scale=reward_scale)
        gamma = check(SHARE, gamma=gamma)
        super().__init__(
            value_network,
            loss_function=loss_function,
            delay_value=True,
            double_dqn=double,
            action_space="one-hot",
            use_prioritized_weights=False,
        )
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.signals, self.importance, self.reward_scale = tuple(signals), importance, reward_scale

    def losses(self, batch: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the loss, and write the signal in ``batch``.

        Args:
            batch: Transitions, batch size ``[B]``, with actions one-hot, ``[B, K]``, or as numbers,
                ``[B, 1]``.

        Returns:
            The loss, and detached values for the log.

        Raises:
            ValueError: If the actions have neither form.
        """
        (online, target), keys = self._networks(), self.tensor_keys
        states, after = self._states(batch), self._states(batch["next"])
        values = online.outputs(states)[keys.action_value]
        number = read_choices(batch[keys.action], values.shape[-1], batch)
        value = values.gather(-1, number.unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            chooser = online if self.double_dqn else target
            choice = chooser.outputs(after)[keys.action]
            next_value = (target.outputs(after)[keys.action_value] * choice).sum(-1)
            aim = estimated_target(  # Eq. (5)
                batch, next_value, self.value_estimator, keys, reward_scale=self.reward_scale
            )
        each = distance(value, aim, self.loss_function, unit=self.reward_scale)  # Eq. (4)
        if self.importance != "none" and (weight := batch.get("priority_weight", None)) is not None:
            weight = weight.reshape(-1)
            each = each * weight / (weight.mean() if self.importance == "torchrl" else 1.0)
        td_error = (aim - value).detach()
        if TD_ERROR.name in self.signals:
            batch.set(TD_ERROR.key, td_error_priority(td_error) / self.reward_scale)  # Eq. (13)
        return each.mean(), {"td_error": td_error.square()}  # Eq. (11)

    def _states(self, source: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Read the inputs of the network, without gradients."""
        return {key: source[key].detach() for key in self.value_network.in_keys}

    def _networks(self) -> tuple[Function, Function]:
        """Return network and target network, bound to the parameters if they are not yet."""
        if self._bound is None:
            network, target = self.value_network, self.target_value_network_params
            self._bound = (
                as_function(bind(network, self.value_network_params)),
                as_function(bind(network, target).requires_grad_(False)),
            )
        return self._bound

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss under the key ``"loss"``, as TorchRL has it.

        Args:
            tensordict: As in :meth:`losses`.

        Returns:
            A tensordict.
        """
        return TensorDict({"loss": self.losses(tensordict)[0]})


def _check_signals(signals: Sequence[str]) -> None:
    """Reject signals that a value for each action does not have."""
    for name in signals:
        if name == ACTION_GRADIENT.name:
            raise ValueError(
                f"signals must not have {name!r}: values of separate actions have no slope. "
                "Leave it out, as with signals=['reward', 'td_error']"
            )
        if name != TD_ERROR.name:
            raise ValueError(f"signals must be among ['td_error'], got {name!r}")
