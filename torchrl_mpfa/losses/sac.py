"""SAC loss that writes the signals of each transition, as the DDPG and TD3 losses do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import SACLoss, ValueEstimators
from torchrl.objectives.sac import compute_rsample_log_prob

from torchrl_mpfa.checks import POSITIVE, SHARE, check
from torchrl_mpfa.losses.base import SignalKeys, SignalLoss
from torchrl_mpfa.losses.functional import estimated_target, least_value, soft_value
from torchrl_mpfa.losses.stacked import Tensors
from torchrl_mpfa.networks import StochasticActor


class SignalSACLoss(SignalLoss, SACLoss):
    r""":class:`~torchrl.objectives.SACLoss` that also writes the signals of Eqs. (13)-(14).

    The target of both critics is :math:`y_i = r_i + \gamma (\min_k Q'_k(s_{i+1}, a') - \alpha
    \ln\pi(a' | s_{i+1}))` with an action :math:`a'` of the current policy; the actor's loss
    is the mean of :math:`\alpha \ln\pi(a | s_i) - \min_k Q_k(s_i, a)`. The temperature
    :math:`\alpha` is tuned until the policy has the entropy ``target_entropy``, minus the number of
    action dimensions by default.

    The signal of Eq. (13) is the larger TD error of the critics, as in TorchRL's own
    ``"td_error"``; gradient and value are those of the first critic. The losses of actor and
    temperature have importance weights only if ``importance`` is ``"torchrl"``. Q contains the
    entropy of later actions, hence so do the signals. The temperature belongs to scaled rewards: in
    units of the environment's reward it is :math:`\alpha` divided by ``reward_scale``, so that a
    smaller factor needs a smaller ``alpha_init`` for the same policy.

    Haarnoja et al. (2018), https://arxiv.org/abs/1812.05905

    Further arguments and errors: see :class:`~torchrl_mpfa.losses.SignalLoss`. The penalty on
    saturation is that of the means before the tanh.

    Args:
        actor_network: Stochastic policy, such as from :func:`~torchrl_mpfa.make_stochastic_actor`.
        qvalue_network: Critic, of which two are made.
        **kwargs: Further arguments, such as TorchRL's ``alpha_init``, ``target_entropy`` and
            ``fixed_alpha``.

    Raises:
        TypeError: If the actor is not stochastic.
        ValueError: If an argument is one of SAC's first version.

    Examples:
        >>> from torchrl_mpfa import make_critic, make_stochastic_actor
        >>> loss = make_sac_loss(make_stochastic_actor(24, 2), make_critic(24, 2))
        >>> float(loss.target_entropy)
        -2.0
    """

    @dataclass
    class _AcceptedKeys(SignalKeys, SACLoss._AcceptedKeys):
        """Keys of TorchRL's loss and of :class:`~torchrl_mpfa.losses.base.SignalKeys`."""

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        **kwargs: Any,
    ) -> None:
        if not isinstance(actor_network, ProbabilisticTensorDictSequential):
            raise TypeError(
                "actor_network must be a ProbabilisticTensorDictSequential, got "
                f"{type(actor_network).__name__}"
            )
        for name in ("value_network", "skip_done_states"):
            if kwargs.get(name):
                raise ValueError(f"{name} is not supported, got {kwargs[name]!r}")
        check(POSITIVE, alpha_init=kwargs.get("alpha_init", 1.0))
        super().__init__(actor_network, qvalue_network, **kwargs)

    def value_loss(
        self,
        tensordict: TensorDictBase,
        *,
        defer_gradient: bool = False,
        loss_function: str | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Add up the critics' losses; write the signals as :meth:`SignalDDPGLoss.loss_value`."""
        networks, keys, estimator = self._networks(), self.tensor_keys, self.value_estimator
        stored, after = self._stored(tensordict), self._states(tensordict["next"])
        value = self._values(stored)
        with torch.no_grad():
            chosen, log_prob = self._sample(after)
            found = [q.outputs({**after, **chosen}) for q in networks.target_critics]
            values = torch.stack([each[keys.state_action_value].squeeze(-1) for each in found])
            next_value = soft_value(values, log_prob, alpha=self._alpha)
            target = estimated_target(  # Eq. (5)
                tensordict, next_value, estimator, keys, reward_scale=self.reward_scale
            )
        loss = self._critic_mean(tensordict, value, target, loss_function)  # Eqs. (4), (11)
        td_error = (target - value).detach()
        action = stored[keys.action]
        self._write_signals(tensordict, value, td_error, action, defer_gradient)  # Eqs. (13), (14)
        metadata = {
            "td_error": td_error.square(),
            "next_state_value": next_value,
            "pred_value": value.detach(),
            "target_value": target,
        }
        return loss, metadata

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute :meth:`value_loss` and the larger error for TorchRL's ``forward``."""
        loss, metadata = self.value_loss(tensordict)
        return loss, {"td_error": metadata["td_error"].amax(0).sqrt()}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss by the critics' least Q, as :meth:`SignalDDPGLoss.loss_actor`.

        Among the values for the log is ``"log_prob"``, ``[B]``, for :meth:`temperature_loss`.
        """
        states, key = self._states(tensordict), self.tensor_keys.state_action_value
        chosen, log_prob = self._sample(states)
        found = [q.outputs({**states, **chosen}) for q in self._networks().frozen_critics]
        values = torch.stack([each[key].squeeze(-1) for each in found])
        each = -soft_value(values, log_prob, alpha=self._alpha)
        loss, log = self._actor_mean(tensordict, each, chosen)
        least = least_value(values.detach())
        return loss, {"log_prob": log_prob.detach(), "state_action_value_actor": least, **log}

    def temperature_loss(self, tensordict: TensorDictBase, log_prob: Tensor) -> Tensor:
        r"""Average the temperature's loss, :math:`-\ln\alpha (\ln\pi(a | s_i) + \bar H)`."""
        return self._mean(tensordict, self.alpha_loss(log_prob))

    def _critics_part(self, batch: TensorDictBase, **options: Any) -> tuple[Tensor, Any]:
        return self.value_loss(batch, **options)

    def _actors_part(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        loss, log = self.actor_loss(batch)
        log_prob = log.pop("log_prob")
        losses = {"loss_actor": loss, "loss_alpha": self.temperature_loss(batch, log_prob)}
        # A new tensor: the step will change the logarithm in place.
        alpha = self.log_alpha.detach().exp()
        return losses, {"alpha": alpha, "entropy": -log_prob.mean(), **log}

    def _sample(self, states: Tensors) -> tuple[dict[NestedKey, Tensor], Tensor]:
        """Sample actions of the policy; return them and means by key, and log-densities ``[B]``."""
        actor, keys = self._networks().actor.network, self.tensor_keys  # type: ignore[attr-defined]
        if isinstance(actor, StochasticActor):
            action, log_prob, mean = actor.sample(states)
        else:
            found = actor.get_dist_params(TensorDict({key: states[key] for key in actor.in_keys}))
            action, log_prob = compute_rsample_log_prob(actor.build_dist_from_params(found))
            mean = found.get(keys.preactivation, None)
        chosen = {keys.action: action}
        return chosen if mean is None else {**chosen, keys.preactivation: mean}, log_prob

    def temperature_parameters(self) -> list[nn.Parameter]:
        """Return the temperature's logarithm, unless it is fixed."""
        return [] if self.fixed_alpha else [self.log_alpha]


def make_sac_loss(
    actor: ProbabilisticTensorDictSequential,
    critic: TensorDictModule,
    *,
    gamma: float = 0.99,
    loss_function: str = "l2",
    **kwargs: Any,
) -> SignalSACLoss:
    """Make a :class:`SignalSACLoss` with one-step targets and the squared error of Eq. (11).

    Args:
        actor: Stochastic policy.
        critic: Critic, of which two are made, with new weights.
        gamma: Discount, in [0, 1].
        loss_function: Distance of value and target. TorchRL's own default is smoothed.
        **kwargs: Arguments of :class:`SignalSACLoss`.

    Examples:
        >>> from torchrl_mpfa import make_critic, make_stochastic_actor
        >>> actor, critic = make_stochastic_actor(24, 2), make_critic(24, 2)
        >>> float(make_sac_loss(actor, critic, target_entropy=-1.0).target_entropy)
        -1.0
    """
    gamma = check(SHARE, gamma=gamma)
    loss = SignalSACLoss(actor, critic, loss_function=loss_function, **kwargs)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss
