"""DQN loss that writes the TD error of each transition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import DQNLoss, ValueEstimators

from torchrl_mpfa.checks import POSITIVE, SHARE, check
from torchrl_mpfa.losses.base import check_importance
from torchrl_mpfa.losses.functional import distance, read_choices, scale_rewards
from torchrl_mpfa.priorities import td_error_priority
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR

_DISTANCES = ("l1", "l2", "smooth_l1")


class SignalDQNLoss(DQNLoss):
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
        double: Whether the next action is that of the network, and not of the target network
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
        check_importance(importance)
        if loss_function not in _DISTANCES:
            raise ValueError(f"loss_function must be one of {_DISTANCES}, got {loss_function!r}")
        check(POSITIVE, reward_scale=reward_scale)
        check(SHARE, gamma=gamma)
        super().__init__(
            value_network,
            # Of which the bent distance is made, in the units of the reward.
            loss_function="l1" if loss_function == "smooth_l1" else loss_function,
            delay_value=True,
            double_dqn=double,
            action_space="one-hot",
            reduction="none",
            use_prioritized_weights=False,
        )
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.signals, self.importance, self.reward_scale = tuple(signals), importance, reward_scale
        self._bends = loss_function == "smooth_l1"
        self._count: int | None = None

    def losses(self, batch: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss; writes the signal in ``batch``.

        Args:
            batch: Transitions, batch size ``[B]``, with actions one-hot, ``[B, K]``, or as numbers,
                ``[B, 1]``.

        Returns:
            The loss, and detached values for the log.

        Raises:
            ValueError: If the actions have neither form.
        """
        scaled = scale_rewards(batch.select(*self.in_keys), self.tensor_keys, self.reward_scale)
        if self._count is None:
            self._count = self._count_actions(batch)
        number = read_choices(batch[self.tensor_keys.action], self._count, batch)
        scaled[self.tensor_keys.action] = nn.functional.one_hot(number, self._count)
        # Transitions of several steps say of how many: the bootstrap is discounted by all of them.
        steps = self.value_estimator.tensor_keys.steps_to_next_obs
        if (count := batch.get(steps, None)) is not None:
            scaled[steps] = count
        each: Tensor = super().forward(scaled)["loss"]
        if self._bends:
            each = distance(each, torch.zeros_like(each), "smooth_l1", unit=self.reward_scale)
        squared = scaled[self.tensor_keys.priority].squeeze(-1)
        if TD_ERROR.name in self.signals:
            size = td_error_priority(squared.sqrt())
            batch.set(TD_ERROR.key, size / self.reward_scale)
        if self.importance != "none" and "priority_weight" in batch.keys():  # noqa: SIM118
            weight = batch["priority_weight"].reshape(-1)
            mean = weight.mean() if self.importance == "torchrl" else 1.0
            each = each * weight / mean
        return each.mean(), {"td_error": squared}

    @torch.no_grad()
    def _count_actions(self, batch: TensorDictBase) -> int:
        """Number of actions that the network values."""
        training = self.value_network.training
        self.value_network.eval()
        with self.value_network_params.to_module(self.value_network):
            values = self.value_network(batch.select(*self.value_network.in_keys))
        self.value_network.train(training)
        return int(values[self.tensor_keys.action_value].shape[-1])

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss under the key ``"loss"``, as TorchRL has it.

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
