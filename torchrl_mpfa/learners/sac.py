"""SAC: actor, critics and temperature move at every update."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_mpfa.learners.base import ActorCriticLearner, OptimizerName
from torchrl_mpfa.losses import SignalSACLoss


class SACLearner(ActorCriticLearner):
    r"""SAC: a stochastic actor, two critics and the temperature, each at every update.

    Haarnoja et al. (2018), https://arxiv.org/abs/1812.05905

    Args:
        loss: The loss with all networks in it.
        actor_lr: Learning rate of the actor.
        critic_lr: Learning rate of the critics.
        alpha_lr: Learning rate of the temperature's logarithm, unless that is fixed. The
            temperature takes some ``1 / alpha_lr`` updates to change by a factor of e.
        critic_weight_decay: L2 decay of the critics' weights.
        tau: :math:`\tau` of Eq. (7); there is no target actor.
        optimizer: ``"adam"`` or ``"radam"``.
        compile: Not supported; here so that learners take the same arguments.

    Raises:
        ValueError: If a rate is not positive, the decay negative, ``tau`` not in (0, 1], or
            ``compile`` not false.

    Examples:
        >>> from torchrl_mpfa import make_critic, make_sac_loss, make_stochastic_actor
        >>> learner = SACLearner(make_sac_loss(make_stochastic_actor(24, 2), make_critic(24, 2)))
        >>> learner.policy.out_keys
        ['preactivation', 'scale', 'action']
    """

    def __init__(
        self,
        loss: SignalSACLoss,
        *,
        actor_lr: float = 1e-4,
        critic_lr: float = 1e-4,
        alpha_lr: float = 3e-4,
        critic_weight_decay: float = 0.0,
        tau: float = 0.01,
        optimizer: OptimizerName = "adam",
        compile: bool | dict[str, Any] = False,
    ) -> None:
        if not alpha_lr > 0:
            raise ValueError(f"alpha_lr must be positive, got {alpha_lr}")
        super().__init__(
            loss,
            critic="qvalue_network_params",
            actor_lr=actor_lr,
            critic_lr=critic_lr,
            critic_weight_decay=critic_weight_decay,
            tau=tau,
            optimizer=optimizer,
            compile=compile,
        )
        if not loss.fixed_alpha:
            self._add_parameters([loss.log_alpha], lr=alpha_lr)

    def _losses(
        self,
        batch: TensorDictBase,
        actor_batch: TensorDictBase | None,
        loss_function: str | None,
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        total, of_critic = self.loss.value_loss(
            batch, defer_gradient=True, loss_function=loss_function
        )
        log = {"loss_value": total, **of_critic}
        if actor_batch is not None:
            loss_actor, of_actor = self.loss.actor_loss(actor_batch)
            log_prob = of_actor.pop("log_prob")
            loss_alpha = self.loss.temperature_loss(actor_batch, log_prob)
            # A new tensor: the step will change the logarithm in place.
            alpha = self.loss.log_alpha.detach().exp()
            log.update(loss_actor=loss_actor, loss_alpha=loss_alpha, alpha=alpha)
            log.update(entropy=-log_prob.mean(), **of_actor)
            total = total + loss_actor + loss_alpha
        return total, log
