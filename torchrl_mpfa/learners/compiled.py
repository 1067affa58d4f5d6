"""An update as one program: gradients, optimizer, target networks, and the check before them.

With networks of a hundred units an update is mostly the cost of calling some five hundred small
operations; ``torch.compile`` makes one program of them. All parameters of a network lie in one
vector, so that optimizer and target step are a few lines of it whatever the network.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_mpfa.checks import check_counts
from torchrl_mpfa.learners.base import ActorCriticLearner
from torchrl_mpfa.learners.flat import FlatParameters
from torchrl_mpfa.learners.gradients import Gradients, Inputs
from torchrl_mpfa.learners.states import refuse_unfinished
from torchrl_mpfa.learners.steps import Step, move
from torchrl_mpfa.losses.base import SignalLoss
from torchrl_mpfa.selection import Trains


class CompilableLearner(ActorCriticLearner):
    """A learner whose update can be one compiled program.

    Args:
        loss: The loss with its networks in it.
        compile: Whether ``torch.compile`` makes one program of an update, or the arguments for it.
            It needs a C++ compiler and half a minute once (the program is kept on disk), and takes
            a third of the time for networks of 64 units. The networks must stay on their device.
        policy_delay: Updates of the critics for one of the actor and of the targets.
        **kwargs: Options of :class:`~torchrl_mpfa.learners.ActorCriticLearner`: ``actor_lr``,
            ``critic_lr``, ``critic_weight_decay``, ``tau``, ``optimizer``.

    Raises:
        TypeError: If the loss is another learner's.
        ValueError: If an argument is out of its range, or the loss cannot be compiled.
    """

    def __init__(
        self,
        loss: SignalLoss,
        *,
        compile: bool | dict[str, Any] = False,
        policy_delay: int = 1,
        **kwargs: Any,
    ) -> None:
        check_counts(policy_delay=policy_delay)
        super().__init__(loss, **kwargs)
        self.policy_delay = policy_delay
        self._compiled: CompiledUpdate | None = None
        if compile:
            arguments = compile if isinstance(compile, dict) else {}
            self._compiled = CompiledUpdate(
                loss, self.optimizer, tau=self.targets.share, compile=arguments
            )

    def _step(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        if self._compiled is None:
            return super()._step(batch, trains, loss_function)
        return self._compiled(batch, trains=trains, loss_function=loss_function)


_NO_STEP = Step(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Vectors(NamedTuple):
    """All that an update changes of a network, each of shape ``[P]``."""

    weights: Tensor
    targets: Tensor
    mean: Tensor
    square: Tensor


class CompiledUpdate:
    """Takes one step of networks, optimizer and target networks, in one call.

    The program writes new values only where all losses are finite.

    Args:
        loss: The loss; its networks must not move to another device later.
        optimizer: Adam or RAdam over its parameters, whose state is kept up to date.
        tau: Share of the networks in the target networks' step.
        compile: Arguments of ``torch.compile``.

    Raises:
        ValueError: If the loss does what this cannot.
    """

    def __init__(
        self, loss: Any, optimizer: torch.optim.Optimizer, *, tau: float, compile: dict[str, Any]
    ) -> None:
        self._gradients = Gradients(loss)
        self._loss, self._tau = loss, tau
        self._own_target_actor = loss.delay_actor
        parts = self._gradients.parts
        of_actor, of_critics = parts.target_parameters
        actor = dict(parts.actor.module.named_parameters())
        own = of_actor if self._own_target_actor else None
        self._actor = FlatParameters(actor, own, optimizer)
        self._critics = FlatParameters(parts.critic_parameters, of_critics, optimizer)
        loss.forget_networks()
        # Apart from other learners, whose recompilations would count against this one's limit.
        self._call: Callable[..., Any] = torch.compile(
            self._program,
            fullgraph=True,
            dynamic=False,
            **{"isolate_recompiles": True, **compile},
        )

    @torch.no_grad()
    def __call__(
        self,
        batch: TensorDictBase,
        *,
        trains: Trains = "both",
        loss_function: str | None = None,
    ) -> dict[str, Tensor]:
        """Take the step.

        Args:
            batch: Transitions, batch size ``[B]``; gets its signals, unless ``trains`` is
                ``"actor"``.
            trains: Who moves. The target networks move with the actor.
            loss_function: Distance of the critics' loss; None: the loss's own.

        Returns:
            Detached values for the log.

        Raises:
            KeyError: If the batch lacks an entry.
            ValueError: If a loss is not finite, or the loss has got a value estimator of several
                steps meanwhile; nothing is changed then.
        """
        given = self._gradients.inputs(batch, trains, loss_function)
        both = self._actor, self._critics
        if any([each.hold() for each in both]):
            self._loss.forget_networks()
        learns = trains != "critic", trains != "actor"
        steps = [
            each.next_step() if on else _NO_STEP for each, on in zip(both, learns, strict=True)
        ]
        actor, critics = (Vectors(e.weights, e.targets, e.mean, e.square) for e in both)
        numbers = torch.tensor(steps, dtype=actor.weights.dtype).to(actor.weights.device)
        signals, log = self._call(actor, critics, numbers, given)
        self._gradients.write_signals(batch, signals)
        refuse_unfinished(log, batch)
        for each, on in zip(both, learns, strict=True):
            if on:
                each.count_step()
        return dict(log)

    def _program(
        self, actor: Vectors, critics: Vectors, numbers: Tensor, given: Inputs
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Signals and values for the log; changes the vectors where all losses are finite."""
        found = self._gradients(
            self._actor.views(actor.weights),
            self._critics.views(critics.weights),
            self._actor.views(actor.targets),
            self._critics.views(critics.targets),
            given,
        )
        losses = [value for name, value in found.log.items() if name.startswith("loss")]
        finite = torch.stack(losses).isfinite().all()
        with_targets = given.actor_state is not None
        for of, flat, gradients, row, own_targets in (
            (actor, self._actor, found.of_actor, 0, self._own_target_actor),
            (critics, self._critics, found.of_critic, 1, True),
        ):
            weights = of.weights
            if gradients:
                step = Step(*numbers[row].unbind())
                moved = move(weights, flat.joined(gradients), of.mean, of.square, step)
                weights = moved.weights
            if with_targets and own_targets:
                targets = of.targets + self._tau * (weights - of.targets)
                _write(finite, [of.targets], [targets])
            if gradients:
                _write(
                    finite, [of.weights, of.mean, of.square], [weights, moved.mean, moved.square]
                )
        return found.signals, found.log


def _write(finite: Tensor, old: Sequence[Tensor], new: Sequence[Tensor]) -> None:
    """Put new values in the place of old ones, if that is finite which they were made of."""
    for before, after in zip(old, new, strict=True):
        before.copy_(torch.where(finite, after, before))
