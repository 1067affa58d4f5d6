"""What all learners share: a loss, one optimizer, target networks.

A learner knows nothing of replay or environment: a batch goes in, signals come back in it. Another
learner has the same methods and takes its place.
"""

from __future__ import annotations

import copy
from typing import Any, ClassVar, Literal, NoReturn, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_mpfa.checks import ABOVE_ZERO, NOT_NEGATIVE, POSITIVE, SHARE, check, check_counts
from torchrl_mpfa.learners.program import CompiledGradients
from torchrl_mpfa.learners.states import check_state, naming, refuse_unfinished
from torchrl_mpfa.learners.targets import MultiTensorSoftUpdate
from torchrl_mpfa.losses import SignalLoss
from torchrl_mpfa.selection import SampledBatch, Trains

OptimizerName = Literal["adam", "radam"]


@runtime_checkable
class Learner(Protocol):
    """What a training loop needs of a learner."""

    policy: TensorDictModule

    def update(self, draw: SampledBatch | TensorDictBase) -> dict[str, Tensor]:
        """Train on a draw, write the signals in its batch, and give values for the log.

        Args:
            draw: What an update is made from; a batch of size ``[B]`` stands for
                ``SampledBatch(batch)``.

        Returns:
            Detached values for the log, of those losses that were computed.
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


class OptimizedLearner:
    """A learner with a loss, one optimizer, target networks, and rates that can be lowered."""

    def __init__(
        self, loss: Any, groups: list[dict[str, Any]], optimizer: OptimizerName, tau: float
    ) -> None:
        self.loss: Any = loss
        self.optimizer = make_optimizer(optimizer, groups)
        self._rates = [group["lr"] for group in groups]
        self.targets = MultiTensorSoftUpdate(loss, tau=tau)
        self.updates = 0
        """Training steps taken."""

    def end_episode(self) -> None:
        """Nothing changes."""

    def anneal(self, factor: float) -> None:
        """Set the learning rates to a fraction of what the constructor was given.

        Args:
            factor: The fraction, in [0, 1].

        Raises:
            ValueError: If ``factor`` is outside.
        """
        check(SHARE, factor=factor)
        for group, rate in zip(self.optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * factor

    def __deepcopy__(self, memo: dict[int, Any]) -> NoReturn:
        # TorchRL's losses hold parameters in ways that a deep copy takes apart: the optimizer of a
        # copy would move none of them.
        raise TypeError(
            f"a {type(self).__name__} cannot be copied: make another one, and have it load the "
            "state_dict() of this one"
        )

    def state_dict(self) -> dict[str, Any]:
        """Networks, target networks, optimizer and count; tensors and plain values only."""
        return {
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "updates": self.updates,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Args:
            state_dict: The state of a learner of the same kind, with networks of the same sizes.

        Raises:
            ValueError: If it is not; nothing is changed then.
        """
        check_state(state_dict, self.state_dict(), self.optimizer)
        self.loss.load_state_dict(state_dict["loss"])
        # PyTorch would share the tensors with whoever gave the state.
        self.optimizer.load_state_dict(copy.deepcopy(state_dict["optimizer"]))
        self.updates = state_dict["updates"]


class ActorCriticLearner(OptimizedLearner):
    r"""One optimizer for actor and critics, target networks, and rates that can be lowered.

    All gradients of an update are taken at the same networks, by one backward pass; then all
    networks take their step. A kind of learner says which loss it takes.

    Args:
        loss: The loss with its networks in it.
        actor_lr: Learning rate of the actor, Table 1.
        critic_lr: Learning rate of the critics, Table 1.
        critic_weight_decay: L2 decay of the critics' weights. A decay of 1e-2, as in the original
            DDPG paper, was seen to hold Q below the returns.
        tau: :math:`\tau` of Eqs. (6)-(7), Table 1.
        optimizer: ``"adam"`` (the paper), or ``"radam"``, which warms up by itself (Liu et al.
            2020, https://arxiv.org/abs/1908.03265).
        policy_delay: Updates of the critics for one of the actor and of the target networks.
        compile: Whether ``torch.compile`` makes one program of the losses and their gradients, or
            the arguments for it. It needs a C++ compiler and half a minute once (the program is
            kept on disk), and takes half of the time for networks of 64 units. The networks must
            stay on their device.

    Raises:
        TypeError: If the loss is another learner's.
        ValueError: If a rate is not positive, the decay negative, ``tau`` not in (0, 1], the delay
            no count, or the optimizer unknown.
    """

    loss_type: ClassVar[type] = SignalLoss
    """The loss that this kind of learner takes."""

    def __init__(
        self,
        loss: Any,
        *,
        actor_lr: float = 1e-4,
        critic_lr: float = 1e-4,
        critic_weight_decay: float = 1e-4,
        tau: float = 0.01,
        optimizer: OptimizerName = "adam",
        policy_delay: int = 1,
        compile: bool | dict[str, Any] = False,
    ) -> None:
        check_counts(policy_delay=policy_delay)
        if not isinstance(loss, SignalLoss) or not isinstance(loss, self.loss_type):
            raise TypeError(
                f"loss of a {type(self).__name__} must be a {self.loss_type.__name__}, got "
                f"{type(loss).__name__}"
            )
        if loss.reduction == "none":  # type: ignore[attr-defined]
            raise ValueError("reduction of the loss must be 'mean' or 'sum', got 'none'")
        check(POSITIVE, actor_lr=actor_lr, critic_lr=critic_lr)
        check(NOT_NEGATIVE, critic_weight_decay=critic_weight_decay)
        check(ABOVE_ZERO, tau=tau)
        groups = [
            {"params": loss.actor_parameters(), "lr": actor_lr},
            {
                "params": loss.critic_parameters(),
                "lr": critic_lr,
                "weight_decay": critic_weight_decay,
            },
        ]
        super().__init__(loss, groups, optimizer, tau)
        self.policy: TensorDictModule = getattr(loss, "actor_network")  # noqa: B009
        self.policy_delay = policy_delay
        arguments = compile if isinstance(compile, dict) else {}
        self._program = CompiledGradients(loss, arguments) if compile else None

    def _add_parameters(self, parameters: list[torch.nn.Parameter], *, lr: float) -> None:
        """Have the optimizer move further parameters of the loss, at a rate of their own."""
        self.optimizer.add_param_group({"params": parameters, "lr": lr})
        self._rates.append(lr)

    def update(self, draw: SampledBatch | TensorDictBase) -> dict[str, Tensor]:
        """One step of the networks and of the target networks, as far as they are due.

        Args:
            draw: What an update is made from; a batch of size ``[B]`` stands for
                ``SampledBatch(batch)``. The critics' loss writes the signals in the batch; the
                target networks move with the actor. If ``draw.new_step`` is false, it is a further
                batch of the same training step, which a delay of the actor does not count.

        Returns:
            Detached values for the log; none where the actor alone is to learn, and is not due.

        Raises:
            KeyError: If the batch lacks an entry.
            RuntimeError: If the batch does not fit the networks.
            ValueError: If a loss is not finite. Nothing of the learner is changed then.
        """
        if not isinstance(draw, SampledBatch):
            draw = SampledBatch(draw)
        updates = self.updates + draw.new_step
        trains, log = draw.trains, {}
        due = updates % self.policy_delay == 0
        if trains == "both" and not due:
            trains = "critic"
        if trains == "critic" or due:
            with naming(draw.batch):
                log = self._step(draw.batch, trains, draw.loss_function)
        self.updates = updates
        return {key: value.detach() for key, value in log.items()}

    def _step(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        """One step of the optimizer, and of the target networks with the actor; give the log."""
        log = self._differentiate(batch, trains, loss_function)
        refuse_unfinished(log, batch)
        self.optimizer.step()
        if trains != "critic":
            self.targets.step()
        return log

    def _differentiate(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        """Set the gradients and give the log; a parameter without one stays, decay and all."""
        self.optimizer.zero_grad(set_to_none=True)
        if self._program is not None:
            return self._program(batch, trains, loss_function)
        losses, log = self.loss.losses(batch, trains=trains, loss_function=loss_function)
        # The loss of a temperature that is fixed has no gradient.
        torch.autograd.backward([loss for loss in losses.values() if loss.requires_grad])
        self.loss.write_action_gradient(batch)
        return {**losses, **log}

    def end_episode(self) -> None:
        """Keep the target critics as they are now, if the loss averages several of them."""
        self.loss.keep_target_critics()


def make_optimizer(name: OptimizerName, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
    """The optimizer of this name, all tensors in one call."""
    if name == "adam":
        return torch.optim.Adam(groups, fused=True)
    if name == "radam":
        return torch.optim.RAdam(groups, foreach=True)
    raise ValueError(f"optimizer must be 'adam' or 'radam', got {name!r}")
