"""TD3: two critics at every update, the actor and the targets at every other one."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_mpfa.learners.base import ActorCriticLearner, OptimizerName
from torchrl_mpfa.losses import SignalTD3Loss


class TD3Learner(ActorCriticLearner):
    r"""TD3: two critics at each update, the actor and all targets at every other one.

    Fujimoto et al. (2018), https://arxiv.org/abs/1802.09477

    Args:
        loss: The loss with all networks in it.
        actor_lr: Learning rate of the actor.
        critic_lr: Learning rate of the critics.
        critic_weight_decay: L2 decay of the critics' weights.
        tau: :math:`\tau` of Eqs. (6)-(7).
        policy_delay: Updates of the critics for one of the actor and of the targets.
        optimizer: ``"adam"`` or ``"radam"``.
        compile: As in :class:`~torchrl_mpfa.learners.ActorCriticLearner`.

    Raises:
        ValueError: If a rate is not positive, the decay negative, ``tau`` not in (0, 1], the delay
            below one, or the loss cannot be compiled.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic, make_td3_loss
        >>> TD3Learner(make_td3_loss(make_actor(24, 2), make_critic(24, 2))).policy_delay
        2
    """

    def __init__(
        self,
        loss: SignalTD3Loss,
        *,
        actor_lr: float = 1e-4,
        critic_lr: float = 1e-4,
        critic_weight_decay: float = 0.0,
        tau: float = 0.01,
        policy_delay: int = 2,
        optimizer: OptimizerName = "adam",
        compile: bool | dict[str, Any] = False,
    ) -> None:
        if policy_delay < 1:
            raise ValueError(f"policy_delay must be at least 1, got {policy_delay}")
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
        self.policy_delay = policy_delay
        self.updates = 0

    def update(
        self,
        batch: TensorDictBase,
        *,
        actor_batch: TensorDictBase | None = None,
        loss_function: str | None = None,
        new_step: bool = True,
    ) -> dict[str, torch.Tensor]:
        """One step of the critics, and when it is due of the actor and of the target networks.

        Args:
            batch: Transitions, batch size ``[B]``; the loss writes their signals.
            actor_batch: What the actor learns from, if that is another batch.
            loss_function: Distance of the critic's loss, if not the loss's own.
            new_step: Whether a new training step begins; false for its further batches, if it has
                several, which a delay of the actor does not count.

        Returns:
            Detached values for the log.
        """
        self.updates += new_step
        due = self.updates % self.policy_delay == 0
        if not due:
            actor_batch = None
        elif actor_batch is None:
            actor_batch = batch
        log = self._descend(batch, actor_batch=actor_batch, loss_function=loss_function)
        if due:
            self.targets.step()
        return log

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
            log.update(loss_actor=loss_actor, **of_actor)
            total = total + loss_actor
        return total, log

    def state_dict(self) -> dict[str, Any]:
        """Networks, target networks, optimizer and the count of updates."""
        return {**super().state_dict(), "updates": self.updates}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        super().load_state_dict(state_dict)
        self.updates = state_dict["updates"]
