"""Networks, target networks and one optimizer behind one ``update``.

A learner knows nothing of replay or environment: a batch goes in, signals come back in it. Another
learner has the same methods and takes its place.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_mpfa.checks import ABOVE_ZERO, SHARE, Rule, check
from torchrl_mpfa.learners.adam import FlatAdam
from torchrl_mpfa.learners.compiled import CompiledUpdate, Step
from torchrl_mpfa.saving import check_saved_numbers
from torchrl_mpfa.selection import SampledBatch, Trains, as_sampled

IMPORTANCE: Rule = (
    lambda use: use in ("critic", "torchrl", "none"),
    "'critic', 'torchrl' or 'none'",
)


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


class OptimizedLearner:
    r"""Networks, targets that follow them, and one optimizer whose rates can be lowered.

    Targets follow by :math:`\theta' \leftarrow \tau\theta + (1 - \tau)\theta'` (Eqs. 6-7). A copy
    shares nothing with the learner. ``groups`` are those of the optimizer's parameters.
    """

    policy_delay = 1
    """Updates of the critics for one of the actor and of the target networks."""

    def __init__(
        self,
        networks: nn.ModuleDict,
        targets: nn.ModuleDict,
        groups: list[dict[str, Any]],
        tau: float,
    ) -> None:
        self.tau = check(ABOVE_ZERO, tau=tau)
        self.networks: Any = networks
        """Networks by name, of ``ActorCritic`` ``"actor"`` and ``"critics"``."""
        self.targets: Any = targets
        """Target networks by the names of the networks that they follow."""
        self.optimizer = self.make_optimizer(groups)
        self._rates = [group["lr"] for group in groups]
        self._program: CompiledUpdate | None = None
        self.updates = 0
        """Training steps taken."""
        self._flatten()

    def make_optimizer(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """Make the optimizer; a learner with another one overrides it."""
        return FlatAdam(groups)

    def _flatten(self) -> None:
        """Make the parameters of a group views of one tensor, and their targets of another."""
        online = [p for name in self.targets for p in self.networks[name].parameters()]
        pairs: list[Any] = list(zip(online, self.targets.parameters(), strict=True))
        flat = []
        if isinstance(self.optimizer, FlatAdam):
            self.optimizer.flatten({id(parameter): target for parameter, target in pairs})
            flat = [group for group in self.optimizer.flat_groups if group.followed]
        in_group = {id(parameter) for group in flat for parameter in group.followed}
        pairs = [pair for pair in pairs if id(pair[0]) not in in_group]
        pairs += [(group.values[: len(group.targets)], group.targets) for group in flat]
        self._online, self._followers = map(list, zip(*pairs, strict=True))
        if self._program is not None:
            self._program.forget()

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
            ValueError: If a loss is not finite, or ``sampled`` has several batches. Nothing of the
                learner is changed then.
        """
        sampled = as_sampled(sampled)
        updates = self.updates + sampled.new_step
        trains, due = sampled.trains, updates % self.policy_delay == 0
        if trains == "both" and not due:
            trains = "critic"
        log: dict[str, Tensor] = {}
        if trains == "critic" or due:
            log = self._step(sampled.batch, trains, sampled.loss_function)
        self.updates = updates
        return log

    def update_each(self, rows: TensorDictBase, batches: int) -> dict[str, Tensor] | None:
        """Make an update with each of ``U`` batches, ``[U * B]``, by the compiled program.

        Return the log of the last one; None, before anything is done, without a program or where
        ``update`` is overridden. An error leaves the updates before its batch made.
        """
        overridden = getattr(self.update, "__func__", None) is not OptimizedLearner.update
        if self._program is None or overridden:
            return None
        self._follow_parameters()
        counts = range(self.updates + 1, self.updates + 1 + batches)
        turns: list[Trains] = ["critic" if n % self.policy_delay else "both" for n in counts]
        size = len(rows) // batches
        with fits_loss(rows):
            steps = self._program.each(rows, size, turns)
        if steps is None:
            return None
        for number, (step, trains) in enumerate(zip(steps, turns, strict=True)):
            if not step.taken:
                self._take_step(step.log, rows[number * size : (number + 1) * size], trains)
            self.updates += 1
        return step.log

    def _step(
        self, batch: TensorDictBase, trains: Trains = "both", loss_function: str | None = None
    ) -> dict[str, Tensor]:
        """Step the optimizer, and the target networks with the actor; return the log."""
        self._follow_parameters()
        with fits_loss(batch):
            step = None if self._program is None else self._program(batch, trains, loss_function)
            if step is None:
                self.optimizer.zero_grad()
                step = Step(self._differentiate(batch, trains, loss_function), False)
        if not step.taken:
            self._take_step(step.log, batch, trains)
        return step.log

    def _differentiate(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        """Set the gradients, write the signals, and return detached values for the log."""
        raise NotImplementedError

    def _take_step(self, log: dict[str, Tensor], batch: TensorDictBase, trains: Trains) -> None:
        """Step by the gradients, if the losses are finite."""
        check_losses(log, batch)
        self.optimizer.step()
        if trains != "critic":
            self.move_targets()

    def _follow_parameters(self) -> None:
        """Flatten again if a parameter was given another tensor, as ``module.to(device)`` does."""
        if isinstance(self.optimizer, FlatAdam) and not self.optimizer.holds():
            self._flatten()

    @property
    def _rounded_tau(self) -> float:
        # As TorchRL computes it, to the last bit.
        return 1.0 - (1.0 - self.tau)

    @torch.no_grad()
    def move_targets(self) -> None:
        """Move the targets by tau towards the networks that they follow (Eqs. 6-7)."""
        torch._foreach_lerp_(self._followers, self._online, self._rounded_tau)

    def record_targets(self, finite: Tensor) -> None:
        """Move the targets by operations that can be recorded, if the losses are finite."""
        for target, online in zip(self._followers, self._online, strict=True):
            moved = torch.lerp(target, online, self._rounded_tau)
            target.copy_(torch.where(finite, moved, target))

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

    def __copy__(self) -> Any:
        return copy.deepcopy(self)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Parameters of a copy or of a pickle are views of nothing yet.
        vars(self).update(state)
        self._flatten()

    def state_dict(self) -> dict[str, Any]:
        """Return networks, targets, optimizer and count, as tensors and plain values.

        Raises:
            ValueError: If a parameter is not finite, as no learner would load it.
        """
        state = self._state()
        self._check_numbers(state)
        return state

    def _state(self) -> dict[str, Any]:
        return {
            "networks": self.networks.state_dict(),
            "targets": self.targets.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "updates": self.updates,
        }

    def _check_numbers(self, state: Mapping[str, Any]) -> None:
        """Reject a state with what is trained, or its moments, not finite.

        Other tensors may be so by design: a causal mask, or a least value that begins at infinity.
        """
        trained = {name for name, p in self.networks.named_parameters() if p.requires_grad}
        for part in ("networks", "targets"):
            numbers = {name: value for name, value in state[part].items() if name in trained}
            check_saved_numbers("learner", numbers)
        check_saved_numbers("learner", state["optimizer"])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state from :meth:`state_dict`.

        Args:
            state_dict: The state of a learner of the same kind, with networks of the same sizes.

        Raises:
            ValueError: If it is of another kind or size, or not finite; nothing is changed then.
        """
        # A twin takes a step, so that it has all moments: PyTorch does not check their sizes, and
        # its fused optimizers write past the end.
        twin = copy.deepcopy(self.optimizer)
        for group in twin.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.zeros_like(parameter)
        twin.step()
        like = {**self._state(), "optimizer": twin.state_dict()}
        check_form("the saved learner", state_dict, like)
        self._check_numbers(state_dict)
        self.networks.load_state_dict(state_dict["networks"])
        self.targets.load_state_dict(state_dict["targets"])
        # PyTorch would share the tensors with the owner of the state.
        self.optimizer.load_state_dict(copy.deepcopy(state_dict["optimizer"]))
        self.updates = state_dict["updates"]


# What is wrong with a batch, a loss or a saved state, and where.


@contextmanager
def fits_loss(batch: TensorDictBase) -> Iterator[None]:
    """Say of which form a batch is that does not fit the loss."""
    try:
        yield
    except RuntimeError as error:
        if type(error) is not RuntimeError:  # Memory or compiler failed, whatever the batch.
            raise
        entries = [(k, v) for k, v in batch.items(True, True) if isinstance(v, Tensor)]
        forms = ", ".join(f"{key!r} {[*value.shape]} {value.dtype}" for key, value in entries)
        raise RuntimeError(f"batch does not fit the loss, got {forms}: {error}") from error


def check_losses(losses: Mapping[str, Tensor], batch: TensorDictBase) -> None:
    """Raise if a value whose name begins with ``"loss"`` is not finite, with entry and row."""
    # One NaN in an observation would make all weights NaN. Losses are looked at and not the batch,
    # as that is one number for each.
    for name, value in losses.items():
        if not name.startswith("loss"):
            continue
        if math.isfinite(value.item()) if value.ndim == 0 else bool(value.isfinite().all()):
            continue
        cause = _first_not_finite(batch)
        if cause is not None:
            raise ValueError(f"batch must be finite, got {cause}")
        raise ValueError(
            f"{name} must be finite, got {value.sum().item()} of a finite batch: lower the "
            "learning rate, or scale the rewards"
        )


def _first_not_finite(batch: TensorDictBase) -> str | None:
    """Describe the first number of a batch that is not finite, but for the signals."""
    for key, value in batch.items(True, True):
        written = key[0] if isinstance(key, tuple) else key
        if written in {"signals", "td_error"} or not torch.is_floating_point(value):
            continue
        rows = (~value.isfinite()).reshape(len(value), -1)
        if bool(rows.any()):
            row = int(rows.any(1).nonzero()[0])
            number = value[row].reshape(-1)[rows[row]][0].item()
            return f"{number} in {key!r}, row {row}"
    return None


def check_form(place: str, state: Any, like: Any) -> None:
    """Raise unless a saved state has entries, types and sizes like another."""
    if isinstance(like, Tensor) and isinstance(state, Tensor):
        # PyTorch keeps a count in the default type of the process that began.
        if state.shape != like.shape or (state.dtype is not like.dtype and like.ndim):
            raise ValueError(f"{place} must be {_form(like)}, got {_form(state)}")
    elif isinstance(like, Mapping) and isinstance(state, Mapping):
        # The moments of an optimizer come with the first gradient of a parameter.
        missing = [] if place.endswith("'state'") else [key for key in like if key not in state]
        if unfit := [*missing, *(key for key in state if key not in like)]:
            word = "lacks" if missing else "must not have"
            raise ValueError(f"{place} {word} {unfit[0]!r}")
        for key, value in state.items():
            check_form(f"{place}, {key!r}", value, like[key])
    elif isinstance(like, list) and isinstance(state, list) and len(like) == len(state):
        for number, pair in enumerate(zip(state, like, strict=True)):
            check_form(f"{place}, {number}", *pair)
    elif type(state) is not type(like) or isinstance(like, list):
        raise ValueError(f"{place} must be {_form(like)}, got {_form(state)}")


def _form(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{value.dtype} of shape {[*value.shape]}"
    if isinstance(value, Mapping):
        return "a mapping"
    return f"a list of {len(value)}" if isinstance(value, list) else repr(value)
