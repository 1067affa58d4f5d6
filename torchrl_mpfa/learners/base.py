"""What all learners share: a loss, one optimizer, target networks.

A learner knows nothing of replay or environment: a batch goes in, signals come back in it. Another
learner has the same methods and takes its place.
"""

from __future__ import annotations

from typing import Any, Literal, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule

from torchrl_mpfa.learners.targets import MultiTensorSoftUpdate
from torchrl_mpfa.losses import SignalDDPGLoss, SignalSACLoss, SignalTD3Loss
from torchrl_mpfa.losses.whole import WholeGradients

OptimizerName = Literal["adam", "radam"]


@runtime_checkable
class Learner(Protocol):
    """What a training loop needs of a learner."""

    policy: TensorDictModule

    def update(
        self,
        batch: TensorDictBase,
        *,
        actor_batch: TensorDictBase | None = None,
        loss_function: str | None = None,
        new_step: bool = True,
    ) -> dict[str, torch.Tensor]:
        """Train on a batch, write the signals in it, and give values for the log.

        Args:
            batch: Transitions, batch size ``[B]``.
            actor_batch: What the actor learns from, if that is another batch.
            loss_function: Distance of the critic's loss, if not the loss's own.
            new_step: Whether a new training step begins; false for its further batches, if it has
                several, which a delay of the actor does not count.

        Returns:
            Detached values for the log.
        """
        ...

    def end_episode(self) -> None:
        """Take note that an episode has ended."""
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
        optimizer: ``"adam"`` (the paper), or ``"radam"``, which warms up by itself (Liu et al.
            2020, https://arxiv.org/abs/1908.03265).
        compile: Whether ``torch.compile`` makes one program of an update, or the arguments for it.
            It needs a C++ compiler and half a minute, and takes a third of the time for networks of
            64 units. The networks must stay on their device.

    Raises:
        ValueError: If a rate is not positive, the decay negative, ``tau`` not in (0, 1], the
            optimizer unknown, or the loss cannot be compiled.
    """

    def __init__(
        self,
        loss: SignalDDPGLoss | SignalTD3Loss | SignalSACLoss,
        *,
        critic: str,
        actor_lr: float,
        critic_lr: float,
        critic_weight_decay: float,
        tau: float,
        optimizer: OptimizerName,
        compile: bool | dict[str, Any],
    ) -> None:
        for name, rate in (("actor_lr", actor_lr), ("critic_lr", critic_lr)):
            if not rate > 0:
                raise ValueError(f"{name} must be positive, got {rate}")
        if critic_weight_decay < 0:
            raise ValueError(f"critic_weight_decay must not be negative, got {critic_weight_decay}")
        if not 0 < tau <= 1:
            raise ValueError(f"tau must be in (0, 1], got {tau}")
        if compile and isinstance(loss, SignalSACLoss):
            raise ValueError(f"compile is not supported with SignalSACLoss, got {compile!r}")
        self._rates: tuple[float, ...] = (actor_lr, critic_lr)
        self.loss = loss
        self.policy: TensorDictModule = loss.actor_network
        self.targets = MultiTensorSoftUpdate(loss, tau=tau)
        actors, critics = (
            list(getattr(loss, name).flatten_keys().values())
            for name in ("actor_network_params", critic)
        )
        groups = [
            {"params": actors, "lr": actor_lr},
            {"params": critics, "lr": critic_lr, "weight_decay": critic_weight_decay},
        ]
        self.optimizer = make_optimizer(optimizer, groups)
        self._whole: WholeGradients | None = None
        if compile and not isinstance(loss, SignalSACLoss):
            self._whole = WholeGradients(loss, compile=compile if isinstance(compile, dict) else {})

    def _add_parameters(self, parameters: list[torch.nn.Parameter], *, lr: float) -> None:
        """Have the optimizer move further parameters of the loss, at a rate of their own."""
        self.optimizer.add_param_group({"params": parameters, "lr": lr})
        self._rates = (*self._rates, lr)

    def update(
        self,
        batch: TensorDictBase,
        *,
        actor_batch: TensorDictBase | None = None,
        loss_function: str | None = None,
        new_step: bool = True,
    ) -> dict[str, torch.Tensor]:
        """One step of all networks and of the target networks.

        Args:
            batch: Transitions, batch size ``[B]``; the loss writes their signals.
            actor_batch: What the actor learns from, if that is another batch.
            loss_function: Distance of the critic's loss, if not the loss's own.
            new_step: Whether a new training step begins; false for its further batches, if it has
                several, which a delay of the actor does not count.

        Returns:
            Detached values for the log.
        """
        if actor_batch is None:
            actor_batch = batch
        log = self._descend(batch, actor_batch=actor_batch, loss_function=loss_function)
        self.targets.step()
        return log

    def _descend(
        self,
        batch: TensorDictBase,
        *,
        actor_batch: TensorDictBase | None,
        loss_function: str | None,
    ) -> dict[str, torch.Tensor]:
        """One step of the optimizer; what has no gradient stays as it is.

        Args:
            batch: What the critic learns from, batch size ``[B]``.
            actor_batch: What the actor learns from; None: the actor stays as it is.
            loss_function: Distance of the critic's loss; None: the loss's own.

        Returns:
            Detached values for the log.
        """
        if self._whole is not None:
            log = self._whole(batch, actor_batch=actor_batch, loss_function=loss_function)
        else:
            self.optimizer.zero_grad(set_to_none=True)
            loss, log = self._losses(batch, actor_batch, loss_function)
            loss.backward()
            self.loss.write_action_gradient(batch)
        self.optimizer.step()
        return {key: value.detach() for key, value in log.items()}

    def _losses(
        self,
        batch: TensorDictBase,
        actor_batch: TensorDictBase | None,
        loss_function: str | None,
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Sum of the losses, with the action gradient deferred, and values for the log."""
        raise NotImplementedError

    def end_episode(self) -> None:
        """Keep the target critics as they are now, if the loss averages several of them."""
        self.loss.keep_target_critics()

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


def make_optimizer(name: OptimizerName, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
    """The optimizer of a learner, all tensors in one call.

    Args:
        name: ``"adam"`` or ``"radam"``.
        groups: Parameters with their learning rates and decays.

    Returns:
        The optimizer.

    Raises:
        ValueError: If the name is unknown.
    """
    if name == "adam":
        return torch.optim.Adam(groups, fused=True)
    if name == "radam":
        return torch.optim.RAdam(groups, foreach=True)
    raise ValueError(f"optimizer must be 'adam' or 'radam', got {name!r}")
