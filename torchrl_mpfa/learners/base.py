"""A loss, one optimizer and target networks behind one ``update``, for actors with critics.

A learner knows nothing of replay or environment: a batch goes in, signals come back in it. Another
learner has the same methods and takes its place.
"""

from __future__ import annotations

import copy
from typing import Any, Literal, NoReturn, Protocol, SupportsIndex, runtime_checkable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_mpfa.checks import ABOVE_ZERO, NOT_NEGATIVE, POSITIVE, SHARE, check, check_counts
from torchrl_mpfa.learners.adam import FlatAdam
from torchrl_mpfa.learners.checks import check_alike, check_losses, fits_loss
from torchrl_mpfa.learners.compiled import CompiledUpdate, Step
from torchrl_mpfa.losses import SignalLoss
from torchrl_mpfa.selection import SampledBatch, Trains

OptimizerName = Literal["adam", "radam"]


@runtime_checkable
class Learner(Protocol):
    """Methods of a learner that a training loop calls."""

    policy: TensorDictModule

    def update(self, sampled: SampledBatch | TensorDictBase) -> dict[str, Tensor]:
        """Train on a batch, write its signals, and return values for the log.

        Args:
            sampled: The batch and the networks that learn from it; a batch of size ``[B]`` stands
                for ``SampledBatch(batch)``.

        Returns:
            Detached values for the log, of the losses that were computed.
        """
        ...

    def end_episode(self) -> None:
        """Signal the end of an episode."""
        ...

    def anneal(self, factor: float) -> None:
        """Set the learning rates to a fraction of their first values."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state from :meth:`state_dict`."""
        ...


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
        self._online, self._target = (list(each) for each in zip(*self._pairs, strict=True))
        # As TorchRL computes it, to the last bit.
        self._weight = 1.0 - (1.0 - tau)

    def flatten(self, optimizer: FlatAdam) -> None:
        """Move the targets of a group of parameters as one tensor."""
        optimizer.flatten({id(online): target for online, target in self._pairs})
        groups = [each for each in optimizer.flat_groups if each.followed]
        done = {id(each) for group in groups for each in group.followed}
        rest = [pair for pair in self._pairs if id(pair[0]) not in done]
        self._online = [each.values[: len(each.targets)] for each in groups] + [o for o, _ in rest]
        self._target = [each.targets for each in groups] + [target for _, target in rest]

    @torch.no_grad()
    def step(self) -> None:
        """Move every target parameter by tau."""
        torch._foreach_lerp_(self._target, self._online, self._weight)

    def record_step(self, finite: Tensor) -> None:
        """Move the targets by operations that can be recorded, if the losses are finite."""
        for target, online in zip(self._target, self._online, strict=True):
            moved = torch.lerp(target, online, self._weight)
            target.copy_(torch.where(finite, moved, target))


class OptimizedLearner:
    """A learner with a loss, one optimizer, target networks, and rates that can be lowered."""

    def __init__(
        self, loss: Any, groups: list[dict[str, Any]], optimizer: OptimizerName, tau: float
    ) -> None:
        tau = check(ABOVE_ZERO, tau=tau)
        self.loss: Any = loss
        self.optimizer = make_optimizer(optimizer, groups)
        self._rates = [group["lr"] for group in groups]
        self.targets = MultiTensorSoftUpdate(loss, tau=tau)
        self._program: CompiledUpdate | None = None
        self._flatten()
        self.updates = 0
        """Training steps taken."""

    def _step(
        self, batch: TensorDictBase, trains: Trains = "both", loss_function: str | None = None
    ) -> dict[str, Tensor]:
        """Step the optimizer, and the target networks with the actor; return the log."""
        self._look()
        with fits_loss(batch):
            made = None if self._program is None else self._program(batch, trains, loss_function)
            if made is None:
                self.clear_gradients()
                values = self._differentiate(batch, trains, loss_function)
                made = Step({name: value.detach() for name, value in values.items()}, False)
        if not made.taken:
            self._take_step(made.log, batch, trains)
        return made.log

    def _take_step(self, log: dict[str, Tensor], batch: TensorDictBase, trains: Trains) -> None:
        """Step by the gradients, if the losses are finite."""
        check_losses(log, batch)
        self.optimizer.step()
        if trains != "critic":
            self.targets.step()

    def _look(self) -> None:
        """Follow changes of the loss, and parameters that lie elsewhere now."""
        if isinstance(self.optimizer, FlatAdam) and not self.optimizer.holds():
            self._flatten()
        if self._program is not None:
            self._program.read_options()

    def clear_gradients(self) -> None:
        """Let no parameter have a gradient."""
        for group in self.optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def _flatten(self) -> None:
        """Make the parameters of a group views of one tensor, and their targets of another."""
        if isinstance(self.optimizer, FlatAdam):
            self.targets.flatten(self.optimizer)
            self.loss.forget_networks()
            if self._program is not None:
                self._program.forget()

    def _differentiate(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        """Set the gradients and return the log; a parameter without a gradient stays as it is."""
        raise NotImplementedError

    def end_episode(self) -> None:
        """Change nothing."""

    def anneal(self, factor: float) -> None:
        """Set the learning rates to a fraction of the constructor's.

        Args:
            factor: The fraction, in [0, 1].

        Raises:
            ValueError: If ``factor`` is outside.
        """
        factor = check(SHARE, factor=factor)
        for group, rate in zip(self.optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * factor

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        # TorchRL's losses hold parameters in ways that a copy takes apart: the optimizer of a copy
        # would move none of them. Copies and pickles are made by this.
        raise TypeError(
            f"a {type(self).__name__} cannot be copied or pickled: make another one, and have it "
            "load the state_dict() of this one"
        )

    def state_dict(self) -> dict[str, Any]:
        """Return networks, targets, optimizer and count, as tensors and plain values."""
        return {
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "updates": self.updates,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state from :meth:`state_dict`.

        Args:
            state_dict: The state of a learner of the same kind, with networks of the same sizes.

        Raises:
            ValueError: If it is of another kind or size, or not finite; nothing is changed then.
        """
        # A twin takes a step, so that it has all moments: PyTorch checks neither their sizes nor
        # those of TorchRL's target networks, and its fused optimizers write past the end.
        twin = copy.deepcopy(self.optimizer)
        for group in twin.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.zeros_like(parameter)
        twin.step()
        check_alike("learner", state_dict, {**self.state_dict(), "optimizer": twin.state_dict()})
        self.loss.load_state_dict(state_dict["loss"])
        # PyTorch would share the tensors with the owner of the state.
        self.optimizer.load_state_dict(copy.deepcopy(state_dict["optimizer"]))
        self.updates = state_dict["updates"]


class ActorCriticLearner(OptimizedLearner):
    r"""DDPG, TD3 or SAC by the loss: one optimizer for actor and critics, and target networks.

    All gradients of an update are taken at the same networks, by one backward pass; then all
    networks take their step, and the target networks follow (Eqs. 4-7).

    Args:
        loss: A :class:`~torchrl_mpfa.losses.SignalLoss` with its networks in it.
        actor_lr: Learning rate of the actor, Table 1.
        critic_lr: Learning rate of the critics, Table 1.
        alpha_lr: Learning rate of the logarithm of SAC's temperature. The temperature takes some
            ``1 / alpha_lr`` updates to change by a factor of e.
        critic_weight_decay: L2 decay of the critics' weights. A decay of 1e-2, as in the original
            DDPG paper, was seen to hold Q below the returns.
        tau: :math:`\tau` of Eqs. (6)-(7), Table 1.
        optimizer: ``"adam"`` (the paper), or ``"radam"``, which warms up by itself (Liu et al.
            2020, https://arxiv.org/abs/1908.03265).
        policy_delay: Updates of the critics for one of the actor and of the target networks; by
            default 2 with a TD3 loss, and 1 with others, as in Eqs. (4)-(7). A delay steadies a
            single critic, too.
        compile: True to make one program of the losses and their gradients by ``torch.compile``,
            or the arguments for it. It needs a C++ compiler and half a minute once (the program is
            kept on disk), and takes half of the time for networks of 64 units. The networks must
            stay on their device. What cannot be compiled stays eager.

    Raises:
        TypeError: If the loss writes no signals.
        ValueError: If a rate is not positive, the decay negative, ``tau`` not in (0, 1], the delay
            no count, the optimizer unknown, or the loss a copy.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic, make_ddpg_loss
        >>> learner = ActorCriticLearner(make_ddpg_loss(make_actor(24, 2), make_critic(24, 2)))
        >>> learner.policy.out_keys
        ['preactivation', 'action']
    """

    def __init__(
        self,
        loss: SignalLoss,
        *,
        actor_lr: float = 1e-4,
        critic_lr: float = 1e-4,
        alpha_lr: float = 3e-4,
        critic_weight_decay: float = 1e-4,
        tau: float = 0.01,
        optimizer: OptimizerName = "adam",
        policy_delay: int | None = None,
        compile: bool | dict[str, Any] = False,
    ) -> None:
        if not isinstance(loss, SignalLoss):
            raise TypeError(f"loss must be a SignalLoss, got {type(loss).__name__}")
        trained = {*map(id, loss.actor_parameters())}
        if not all(id(each) in trained for each in loss.actor_network.parameters()):
            # The policy of the copy would keep its first weights.
            raise ValueError("loss must be no copy: make another, and load a state_dict() in it")
        if loss.reduction == "none":
            raise ValueError("reduction of the loss must be 'mean' or 'sum', got 'none'")
        delay = loss.policy_delay if policy_delay is None else policy_delay
        self.policy_delay: int = check_counts(policy_delay=delay)
        actor_lr, critic_lr, alpha_lr = check(
            POSITIVE, actor_lr=actor_lr, critic_lr=critic_lr, alpha_lr=alpha_lr
        )
        decay = {"weight_decay": check(NOT_NEGATIVE, critic_weight_decay=critic_weight_decay)}
        groups = [
            {"params": loss.actor_parameters(), "lr": actor_lr},
            {"params": loss.critic_parameters(), "lr": critic_lr, **decay},
        ]
        if of_temperature := loss.temperature_parameters():
            groups.append({"params": of_temperature, "lr": alpha_lr})
        super().__init__(loss, groups, optimizer, tau)
        self.policy: TensorDictModule = loss.actor_network
        arguments = compile if isinstance(compile, dict) else {}
        if compile:
            self._program = CompiledUpdate(self, arguments)

    def update(self, sampled: SampledBatch | TensorDictBase) -> dict[str, Tensor]:
        """Step the networks and the target networks, as far as they are due.

        Args:
            sampled: The batch and the networks that learn from it; a batch of size ``[B]`` stands
                for ``SampledBatch(batch)``. The critics' loss writes the signals in the batch; the
                target networks move with the actor. A false ``new_step`` marks a further batch of
                the same training step, which a delay of the actor does not count.

        Returns:
            Detached values for the log; none for a batch of the actor alone that is not due.

        Raises:
            KeyError: If the batch lacks an entry.
            RuntimeError: If the batch does not fit the networks.
            ValueError: If a loss is not finite. Nothing of the learner is changed then.
        """
        if not isinstance(sampled, SampledBatch):
            sampled = SampledBatch(sampled)
        updates = self.updates + sampled.new_step
        trains, due = sampled.trains, self._is_due(updates)
        if trains == "both" and not due:
            trains = "critic"
        log: dict[str, Tensor] = {}
        if trains == "critic" or due:
            log = self._step(sampled.batch, trains, sampled.loss_function)
        self.updates = updates
        return log

    def update_each(self, rows: TensorDictBase, batch_size: int) -> dict[str, Tensor] | None:
        """Make an update with each batch of rows by the compiled program, and write their signals.

        Args:
            rows: Batches of one size, one after the other, ``[U * B]``.
            batch_size: ``B``.

        Returns:
            The log of the last update; None, before anything is done, without a program or with an
            ``update`` of one's own.

        Raises:
            KeyError: As :meth:`update`.
            RuntimeError: As :meth:`update`.
            ValueError: As :meth:`update`, of whose kind the earlier ones were made.
        """
        own = getattr(self.update, "__func__", None) is not ActorCriticLearner.update
        if self._program is None or own:
            return None
        self._look()
        counts = range(self.updates + 1, self.updates + 1 + len(rows) // batch_size)
        turns: list[Trains] = ["both" if self._is_due(each) else "critic" for each in counts]
        with fits_loss(rows):
            steps = self._program.each(rows, batch_size, turns)
        if steps is None:
            return None
        for number, (made, trains) in enumerate(zip(steps, turns, strict=True)):
            if not made.taken:
                start = number * batch_size
                self._take_step(made.log, rows[start : start + batch_size], trains)
            self.updates += 1
        return made.log

    def _is_due(self, update: int) -> bool:
        """Return True if an update of this number is one of the actor and the targets as well."""
        return update % self.policy_delay == 0

    def _differentiate(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        """Set the gradients and return the log; a parameter without a gradient stays as it is."""
        losses, log = self.loss.losses(batch, trains=trains, loss_function=loss_function)
        # The loss of a temperature that is fixed has no gradient.
        torch.autograd.backward([loss for loss in losses.values() if loss.requires_grad])
        self.loss.write_action_gradient(batch)
        return {**losses, **log}

    def end_episode(self) -> None:
        """Keep the target critics' present state, if the loss averages several of them."""
        self.loss.keep_target_critics()


DDPGLearner = TD3Learner = SACLearner = ActorCriticLearner
"""The learner by the algorithm of its loss, for scripts that read better with that name."""


def make_optimizer(name: OptimizerName, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
    """Make the optimizer of this name, which steps all tensors in one call."""
    if name == "adam":
        return FlatAdam(groups)
    if name == "radam":
        return torch.optim.RAdam(groups, foreach=True)
    raise ValueError(f"optimizer must be 'adam' or 'radam', got {name!r}")
