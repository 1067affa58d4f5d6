"""The learner: networks, loss, optimizers and target networks behind one ``update``.

It knows nothing of replay or environment: a batch goes in, signals come back in it. Another
learner has the same methods and takes its place.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_mpfa.losses import SignalDDPGLoss, SignalTD3Loss
from torchrl_mpfa.losses.whole import WholeGradients


@runtime_checkable
class Learner(Protocol):
    """What a training loop needs of a learner."""

    policy: TensorDictModule

    def update(self, batch: TensorDictBase) -> dict[str, torch.Tensor]:
        """Train on a batch, write the signals in it, and give values for the log."""
        ...

    def anneal(self, factor: float) -> None:
        """Set the learning rates to a fraction of their first values."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next update depends on."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        ...


class ActorCriticLearner:
    r"""One optimizer for actor and critic, target networks, and rates that can be lowered.

    Args:
        loss: The loss with its networks in it.
        critic: Name of the critic's parameters in the loss.
        actor_lr: Learning rate of the actor, Table 1.
        critic_lr: Learning rate of the critic, Table 1.
        critic_weight_decay: L2 decay of the critic's weights, as in the original DDPG paper; it
            keeps Q and its slope from growing without bound.
        tau: :math:`\tau` of Eqs. (6)-(7), Table 1.
        compile: Whether ``torch.compile`` makes one program of an update, or the arguments for it.
            It needs a C++ compiler and half a minute, and takes a third of the time for networks of
            64 units. The networks must stay on their device.

    Raises:
        ValueError: If a rate is not positive, the decay negative, or ``tau`` not in (0, 1], or the
            loss cannot be compiled.
    """

    def __init__(
        self,
        loss: SignalDDPGLoss | SignalTD3Loss,
        *,
        critic: str,
        actor_lr: float,
        critic_lr: float,
        critic_weight_decay: float,
        tau: float,
        compile: bool | dict[str, Any],
    ) -> None:
        for name, rate in (("actor_lr", actor_lr), ("critic_lr", critic_lr)):
            if not rate > 0:
                raise ValueError(f"{name} must be positive, got {rate}")
        if critic_weight_decay < 0:
            raise ValueError(f"critic_weight_decay must not be negative, got {critic_weight_decay}")
        if not 0 < tau <= 1:
            raise ValueError(f"tau must be in (0, 1], got {tau}")
        self._rates = (actor_lr, critic_lr)
        self.loss = loss
        self.policy: TensorDictModule = loss.actor_network
        self.targets = MultiTensorSoftUpdate(loss, tau=tau)
        actors, critics = (
            list(getattr(loss, name).flatten_keys().values())
            for name in ("actor_network_params", critic)
        )
        self.optimizer = torch.optim.Adam(
            [
                {"params": actors, "lr": actor_lr},
                {"params": critics, "lr": critic_lr, "weight_decay": critic_weight_decay},
            ],
            fused=True,
        )
        self._whole: WholeGradients | None = None
        if compile:
            self._whole = WholeGradients(loss, compile=compile if isinstance(compile, dict) else {})

    def _descend(self, batch: TensorDictBase, *, with_actor: bool) -> dict[str, torch.Tensor]:
        """One step of the optimizer; what has no gradient stays as it is."""
        self.optimizer.zero_grad(set_to_none=True)
        if self._whole is not None:
            log = self._whole(batch, with_actor=with_actor)
        else:
            loss, log = self._losses(batch, with_actor=with_actor)
            loss.backward()
            self.loss.write_action_gradient(batch)
        self.optimizer.step()
        return {key: value.detach() for key, value in log.items()}

    def _losses(
        self, batch: TensorDictBase, *, with_actor: bool
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Sum of the losses, with the action gradient deferred, and values for the log."""
        raise NotImplementedError

    def anneal(self, factor: float) -> None:
        """Set the learning rates to a fraction of what the constructor was given.

        Args:
            factor: The fraction, in [0, 1].

        Raises:
            ValueError: If ``factor`` is outside.
        """
        if not 0.0 <= factor <= 1.0:
            raise ValueError(f"factor must be in [0, 1], got {factor}")
        for group, rate in zip(self.optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * factor

    def state_dict(self) -> dict[str, Any]:
        """Networks, target networks and optimizers; tensors and plain values only."""
        return {"loss": self.loss.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        self.loss.load_state_dict(state_dict["loss"])
        self.optimizer.load_state_dict(state_dict["optimizer"])


class DDPGLearner(ActorCriticLearner):
    r"""DDPG with target networks, Eqs. (4)-(7), and the actor's sampled policy gradient.

    Args:
        loss: The loss with both networks in it.
        actor_lr: Learning rate of the actor, Table 1.
        critic_lr: Learning rate of the critic, Table 1.
        critic_weight_decay: L2 decay of the critic's weights, as in the original DDPG paper.
        tau: :math:`\tau` of Eqs. (6)-(7), Table 1.
        compile: As in :class:`ActorCriticLearner`.

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
        compile: bool | dict[str, Any] = False,
    ) -> None:
        super().__init__(
            loss,
            critic="value_network_params",
            actor_lr=actor_lr,
            critic_lr=critic_lr,
            critic_weight_decay=critic_weight_decay,
            tau=tau,
            compile=compile,
        )

    def update(self, batch: TensorDictBase) -> dict[str, torch.Tensor]:
        """One step of both networks and of the target networks.

        Args:
            batch: Transitions, batch size ``[B]``; the loss writes their signals.

        Returns:
            Detached values for the log.
        """
        log = self._descend(batch, with_actor=True)
        self.targets.step()
        return log

    def _losses(
        self, batch: TensorDictBase, *, with_actor: bool
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        loss_value, of_critic = self.loss.loss_value(batch, defer_gradient=True)
        loss_actor, of_actor = self.loss.loss_actor(batch)
        log = {"loss_value": loss_value, "loss_actor": loss_actor, **of_critic, **of_actor}
        return loss_value + loss_actor, log


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
        compile: As in :class:`ActorCriticLearner`.

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
            compile=compile,
        )
        self.policy_delay = policy_delay
        self.updates = 0

    def update(self, batch: TensorDictBase) -> dict[str, torch.Tensor]:
        """One step of the critics, and when it is due of the actor and of the target networks.

        Args:
            batch: Transitions, batch size ``[B]``; the loss writes their signals.

        Returns:
            Detached values for the log.
        """
        self.updates += 1
        due = self.updates % self.policy_delay == 0
        log = self._descend(batch, with_actor=due)
        if due:
            self.targets.step()
        return log

    def _losses(
        self, batch: TensorDictBase, *, with_actor: bool
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        total, log = self.loss.value_loss(batch, defer_gradient=True)
        log = {"loss_value": total, **log}
        if with_actor:
            loss_actor, of_actor = self.loss.actor_loss(batch)
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


class MultiTensorSoftUpdate(SoftUpdate):
    r"""Target networks, :math:`\theta' \leftarrow \tau\theta + (1 - \tau)\theta'` (Eqs. 6-7).

    :class:`~torchrl.objectives.SoftUpdate` with all tensors in one call: one by one they take
    a fifth of a training step.

    Args:
        loss: A loss with target parameters; they are set to the current ones.
        tau: :math:`\tau`.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic, make_ddpg_loss
        >>> loss = make_ddpg_loss(make_actor(24, 2), make_critic(24, 2))
        >>> MultiTensorSoftUpdate(loss, tau=0.01).step()
    """

    def __init__(self, loss: LossModule, *, tau: float) -> None:
        super().__init__(loss, tau=tau)
        params = dict(loss.named_parameters())
        buffers = {**params, **dict(loss.named_buffers())}
        pairs = [(p, buffers.get(f"target_{name}")) for name, p in params.items()]
        self._pairs = [(online, target) for online, target in pairs if target is not None]
        self._move = get_ema_multi_avg_fn(1.0 - tau)

    def step(self) -> None:
        """Move every target parameter by tau."""
        online, target = zip(*self._pairs, strict=True)
        self._move(list(target), list(online), 0)
