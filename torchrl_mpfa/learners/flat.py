"""Parameters of a network laid in one vector, so that a step is arithmetic on few tensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchrl_mpfa.learners.steps import STEPS, Step

Tensors = dict[str, Tensor]


class FlatParameters:
    """Parameters, their targets and their moments in the optimizer, each as one vector.

    The tensors themselves become views of these vectors and stay what they are for everyone else.
    Whatever lays them elsewhere, such as a state that is loaded, is noticed at the next
    :meth:`hold`.

    Args:
        parameters: Parameters by name.
        targets: Target parameters by the same names; None: they have none of their own.
        optimizer: The optimizer that keeps the moments; it takes no step itself any more.

    Raises:
        ValueError: If the parameters are not all of one type.
    """

    def __init__(
        self,
        parameters: Tensors,
        targets: Tensors | None,
        optimizer: torch.optim.Optimizer,
    ) -> None:
        learned = {name: value for name, value in parameters.items() if value.requires_grad}
        kinds = sorted({str(value.dtype) for value in learned.values()})
        if len(kinds) > 1:
            raise ValueError(f"compile needs parameters of one dtype, got {kinds}")
        self._shapes = {name: value.shape for name, value in learned.items()}
        self._fixed = {name: value for name, value in parameters.items() if name not in learned}
        self._parameters = list(learned.values())
        self._targets = None if targets is None else [targets[name] for name in learned]
        self._optimizer = optimizer
        self.weights = self.targets = self.mean = self.square = torch.empty(0)
        self.hold()

    def hold(self) -> bool:
        """Lay everything in vectors, unless it lies there still.

        Returns:
            Whether it did not.
        """
        moved = not _lies_in(self._parameters[0], self.weights)
        if moved:
            self.weights = _lay(self._parameters)
            self.targets = self.weights if self._targets is None else _lay(self._targets)
        state = self._optimizer.state.get(self._parameters[0])
        if not state:
            self.mean, self.square = (torch.zeros_like(self.weights) for _ in range(2))
        elif not _lies_in(state["exp_avg"], self.mean):
            states = [self._optimizer.state[each] for each in self._parameters]
            self.mean = _lay([each["exp_avg"] for each in states])
            self.square = _lay([each["exp_avg_sq"] for each in states])
        return moved

    def views(self, vector: Tensor) -> Tensors:
        """The parts of a vector by the name and in the shape of the parameters, and fixed ones."""
        parts = vector.split([shape.numel() for shape in self._shapes.values()])
        pairs = zip(self._shapes.items(), parts, strict=True)
        return {**self._fixed, **{name: part.view(shape) for (name, shape), part in pairs}}

    def joined(self, tensors: Tensors) -> Tensor:
        """Tensors of the names of the parameters, as one vector."""
        return torch.cat([tensors[name].reshape(-1) for name in self._shapes])

    @property
    def _group(self) -> Mapping[str, Any]:
        """Settings of the optimizer for these parameters; loading a state replaces them."""
        return next(
            group
            for group in self._optimizer.param_groups
            if any(each is self._parameters[0] for each in group["params"])
        )

    def next_step(self) -> Step:
        """Numbers of the step that comes next."""
        state = self._optimizer.state.get(self._parameters[0])
        count = 1 + (int(state["step"]) if state else 0)
        return STEPS[type(self._optimizer)](self._group, count)

    def count_step(self) -> None:
        """Take note in the optimizer that a step was taken."""
        state = self._optimizer.state
        if self._parameters[0] not in state:
            means, squares = self.views(self.mean), self.views(self.square)
            for name, each in zip(self._shapes, self._parameters, strict=True):
                step = torch.zeros((), dtype=torch.float32, device=self._step_device(each))
                moments = {"exp_avg": means[name], "exp_avg_sq": squares[name]}
                state[each] = {"step": step, **moments}
        torch._foreach_add_([state[each]["step"] for each in self._parameters], 1)

    def _step_device(self, parameter: Tensor) -> torch.device:
        return parameter.device if self._group.get("fused") else torch.device("cpu")


def _lies_in(tensor: Tensor, vector: Tensor) -> bool:
    return tensor.data_ptr() == vector.data_ptr()


def _lay(tensors: list[Tensor]) -> Tensor:
    """Lay tensors in a vector that they are views of from then on."""
    vector = torch.cat([each.detach().reshape(-1) for each in tensors])
    for each, part in zip(tensors, vector.split([t.numel() for t in tensors]), strict=True):
        each.data = part.view(each.shape)
    return vector
