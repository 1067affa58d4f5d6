"""DDPG: actor and critic move at every update."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_mpfa.learners.base import ActorCriticLearner, OptimizerName
from torchrl_mpfa.losses import SignalDDPGLoss


class DDPGLearner(ActorCriticLearner):
    r"""DDPG with target networks, Eqs. (4)-(7), and the actor's sampled policy gradient.

    Args:
        loss: The loss with both networks in it.
        actor_lr: Learning rate of the actor, Table 1.
        critic_lr: Learning rate of the critic, Table 1.
        critic_weight_decay: L2 decay of the critic's weights, as in the original DDPG paper.
        tau: :math:`\tau` of Eqs. (6)-(7), Table 1.
        optimizer: ``"adam"`` or ``"radam"``.
        compile: As in :class:`~torchrl_mpfa.learners.ActorCriticLearner`.

    Raises:
        ValueError: If a rate is not positive, the decay negative, ``tau`` not in (0, 1], or the
            loss cannot be compiled.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic, make_ddpg_loss
        >>> learner = DDPGLearner(make_ddpg_loss(make_actor(24, 2), make_critic(24, 2)))
        >>> learner.policy.out_keys
        ['preactivation', 'action']
    """

    def __init__(
        self,
        loss: SignalDDPGLoss,
        *,
        actor_lr: float = 1e-4,
        critic_lr: float = 1e-4,
        critic_weight_decay: float = 1e-2,
        tau: float = 0.01,
        optimizer: OptimizerName = "adam",
        compile: bool | dict[str, Any] = False,
    ) -> None:
        super().__init__(
            loss,
            critic="value_network_params",
            actor_lr=actor_lr,
            critic_lr=critic_lr,
            critic_weight_decay=critic_weight_decay,
            tau=tau,
            optimizer=optimizer,
            compile=compile,
        )

    def _losses(
        self,
        batch: TensorDictBase,
        actor_batch: TensorDictBase | None,
        loss_function: str | None,
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        total, of_critic = self.loss.loss_value(
            batch, defer_gradient=True, loss_function=loss_function
        )
        log = {"loss_value": total, **of_critic}
        if actor_batch is not None:
            loss_actor, of_actor = self.loss.loss_actor(actor_batch)
            log.update(loss_actor=loss_actor, **of_actor)
            total = total + loss_actor
        return total, log
