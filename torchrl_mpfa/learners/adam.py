"""Adam on one tensor for each group of parameters, of which the parameters are views.

With networks of a hundred units, a call for each of their tensors takes longer than its arithmetic.
The moments and the target networks lie in one tensor for a group as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

_MOMENTS = ("exp_avg", "exp_avg_sq")


class FlatGroup:
    """Parameters of an optimizer's group and targets of some, as views of one tensor, ``[P]``."""

    def __init__(self, group: dict[str, Any], target_of: Mapping[int, Tensor]) -> None:
        self.group = group
        # Those with a target are first, so that all targets are one tensor, too.
        order = sorted(group["params"], key=lambda parameter: id(parameter) not in target_of)
        self.parameters: list[Tensor] = order
        self.followed = [parameter for parameter in order if id(parameter) in target_of]
        targets = [target_of[id(parameter)] for parameter in self.followed]
        self.values, self.targets = _as_views(order), _as_views(targets)
        self._views = [*order, *targets]
        self._addresses = [view.data_ptr() for view in self._views]
        self.count = 0
        """Steps taken."""
        self.moments = [torch.zeros_like(self.values) for _ in _MOMENTS]
        """Mean and mean square of the gradients, ``[P]`` each."""
        like: dict[str, Any] = {"dtype": torch.float32, "device": self.values.device}
        self._steps = torch.zeros(len(order), **like)
        self.scales = torch.ones(2, **like)
        """Step size, and root of the square's correction, of a recorded step."""
        # Written as an array: operations of PyTorch, cold after a program, take ten times as long.
        self._scales: Any = self.scales.numpy() if self.scales.is_cpu else self.scales
        self.ready = False
        """True if the moments are those of the optimizer's state."""

    def holds(self) -> bool:
        """Return True if the parameters and their targets are still views."""
        return [view.data_ptr() for view in self._views] == self._addresses

    def tensors(self) -> list[Tensor]:
        """Return all that a recorded step reads or changes."""
        return [self.values, self.targets, *self.moments, self._steps, self.scales]

    def take_moments(self, state: Any) -> bool:
        """Have an optimizer's state view the moments; return False if it is none of one group."""
        states = [state[parameter] for parameter in self.parameters if parameter in state]
        counts = {float(entry["step"]) for entry in states} or {0.0}
        if len(states) not in (0, len(self.parameters)) or len(counts) > 1:
            return False
        for moment, key in zip(self.moments, _MOMENTS, strict=True):
            # What is read may be a view of what is written.
            parts = [entry[key].reshape(-1) for entry in states]
            moment.copy_(torch.cat(parts) if parts else torch.zeros_like(moment))
        self.count = int(counts.pop())
        self._steps.fill_(self.count)
        if states:
            self._give_moments(state)
        self.ready = True
        return True

    def _give_moments(self, state: Any) -> None:
        views = zip(*(_views(moment, self.parameters) for moment in self.moments), strict=True)
        for parameter, step, pair in zip(self.parameters, self._steps, views, strict=True):
            state[parameter] = {"step": step, **dict(zip(_MOMENTS, pair, strict=True))}

    def count_step(self, state: Any) -> None:
        """Count a step that is taken, of which the first gives the optimizer its state."""
        if self.count == 0:
            self._give_moments(state)
        self.count += 1

    def step(self) -> None:
        """Take a step, by PyTorch's kernel."""
        group, (mean, square) = self.group, self.moments
        self._steps += 1
        torch._fused_adam_(
            [self.values],
            [self._gradient()],
            [mean],
            [square],
            [],
            [self._steps[0]],
            lr=group["lr"],
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            amsgrad=False,
            maximize=False,
        )

    def scale(self) -> None:
        """Set the scales of the next step, for a program that takes it."""
        first, second = (1.0 - beta ** (self.count + 1) for beta in self.group["betas"])
        self._scales[0], self._scales[1] = self.group["lr"] / first, second**0.5

    def record_step(self, finite: Tensor) -> None:
        """Take a step by operations that can be recorded, and only if the losses are finite."""
        (beta, beta_of_square), (size, root) = self.group["betas"], self.scales
        gradient = self._gradient()
        if decay := self.group["weight_decay"]:
            gradient = gradient + decay * self.values
        mean = torch.lerp(self.moments[0], gradient, 1.0 - beta)
        square = beta_of_square * self.moments[1] + (1.0 - beta_of_square) * gradient * gradient
        values = self.values - size * mean / (square.sqrt() / root + self.group["eps"])
        state, moved = (*self.moments, self.values, self._steps), (mean, square, values)
        for old, new in zip(state, (*moved, self._steps + 1), strict=True):
            old.copy_(torch.where(finite, new, old))

    def _gradient(self) -> Tensor:
        return torch.cat([parameter.grad.reshape(-1) for parameter in self.parameters])  # type: ignore[union-attr]


class FlatAdam(torch.optim.Adam):
    """Adam, one call for each group of parameters; its states are those of PyTorch's."""

    flat_groups: tuple[FlatGroup, ...] = ()

    def __init__(self, groups: list[dict[str, Any]]) -> None:
        super().__init__(groups, fused=True)

    def flatten(self, target_of: Mapping[int, Tensor]) -> None:
        """Make parameters, and the targets by identity of what they follow, views of one tensor."""
        self.flat_groups = ()
        if all(_alike(group["params"]) for group in self.param_groups):
            self.flat_groups = tuple(FlatGroup(group, target_of) for group in self.param_groups)

    def holds(self) -> bool:
        """Return True if the parameters are still views, as :meth:`flatten` has made them."""
        return all(flat.holds() for flat in self.flat_groups)

    def is_flat(self) -> bool:
        """Return True if groups can be moved by a call each; take their moments if they must be."""
        return bool(self.flat_groups) and all(
            (flat.ready or flat.take_moments(self.state))
            and not (flat.group["amsgrad"] or flat.group["maximize"])
            for flat in self.flat_groups
        )

    def due_groups(self) -> list[FlatGroup] | None:
        """Return the groups with gradients; None if only a part of one has them."""
        due = []
        for flat in self.flat_groups:
            missing = [parameter.grad is None for parameter in flat.parameters]
            if any(missing) and not all(missing):
                return None
            if not any(missing):
                due.append(flat)
        return due

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """Move the parameters that have gradients."""
        due = self.due_groups() if closure is None and self.is_flat() else None
        if due is None:
            self._forget_moments()
            return super().step(closure)
        for flat in due:
            flat.count_step(self.state)
            flat.step()
        return None

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state of PyTorch's Adam."""
        super().load_state_dict(state_dict)
        for flat, group in zip(self.flat_groups, self.param_groups, strict=False):
            flat.group = group
        self._forget_moments()

    def _forget_moments(self) -> None:
        """Have the moments taken out of the state again before the next step."""
        for flat in self.flat_groups:
            flat.ready = False


def _as_views(tensors: list[Tensor]) -> Tensor:
    """Join tensors in one, ``[P]``, of which each is a view from now on."""
    if not tensors:
        return torch.empty(0)
    flat = torch.cat([tensor.detach().reshape(-1) for tensor in tensors])
    for tensor, view in zip(tensors, _views(flat, tensors), strict=True):
        tensor.data = view
    return flat


def _views(flat: Tensor, tensors: Iterable[Tensor]) -> list[Tensor]:
    """Return views of a tensor ``[P]`` in the shapes of these tensors."""
    tensors = list(tensors)
    parts = flat.split([tensor.numel() for tensor in tensors])
    return [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)]


def _alike(tensors: list[Tensor]) -> bool:
    """Return True if tensors have one type and one device."""
    return len({(tensor.dtype, tensor.device) for tensor in tensors}) == 1
