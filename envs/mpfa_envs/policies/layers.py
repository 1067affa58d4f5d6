"""Layers of a trained network in NumPy, so that a policy runs without PyTorch."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.sensing.observation import Binning

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Linear:
    """``y = x W^T + b``."""

    weight: NDArray[np.float32]
    """Shape ``[outputs, inputs]``."""
    bias: NDArray[np.float32]
    """Shape ``[outputs]``."""

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """From ``[N, inputs]`` to ``[N, outputs]``."""
        return x @ self.weight.T + self.bias

    def output_size(self, input_size: int | None) -> int:
        """Check the shapes, and give the number of outputs."""
        if self.weight.ndim != 2 or input_size not in (None, self.weight.shape[1]):
            raise ValueError(
                f"weight must have shape [outputs, {input_size or 'inputs'}], "
                f"got {self.weight.shape}"
            )
        outputs = int(self.weight.shape[0])
        _check_shape("bias", self.bias, outputs)
        return outputs


class _SameSize:
    """A layer with as many outputs as inputs, and as many of each of its weights."""

    def output_size(self, input_size: int | None) -> int | None:
        """Check the shapes, and give the number of outputs."""
        for name, value in arrays_of(self).items():
            input_size = value.size if input_size is None else input_size
            _check_shape(name, value, input_size)
        return input_size


@dataclass(frozen=True)
class LayerNorm(_SameSize):
    """``y = (x - mean) / sqrt(variance + eps) * weight + bias`` over the last dimension."""

    weight: NDArray[np.float32]
    """Shape ``[size]``."""
    bias: NDArray[np.float32]
    """Shape ``[size]``."""
    eps: float

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """From ``[N, size]`` to the same shape."""
        centered = x - x.mean(axis=-1, keepdims=True)
        variance = np.square(centered).mean(axis=-1, keepdims=True)
        found: NDArray[np.float64] = centered / np.sqrt(variance + self.eps)
        return found * self.weight + self.bias

    def output_size(self, input_size: int | None) -> int | None:
        """Check the shapes, and give the number of outputs."""
        if not (math.isfinite(self.eps) and self.eps > 0):
            raise ValueError(f"eps must be positive, got {self.eps}")
        return super().output_size(input_size)


@dataclass(frozen=True)
class ReLU(_SameSize):
    """``y = max(x, 0)``."""

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of any shape."""
        return np.maximum(x, 0.0)


@dataclass(frozen=True)
class Tanh(_SameSize):
    """``y = tanh(x)``."""

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of any shape."""
        return np.tanh(x)


@dataclass(frozen=True)
class Scale(_SameSize):
    """``y = center + half x``, from [-1, 1] to the bounds of the actions."""

    center: NDArray[np.float32]
    """Shape ``[size]``."""
    half: NDArray[np.float32]
    """Shape ``[size]``."""

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """From ``[N, size]`` to the same shape."""
        return self.center + self.half * x


@dataclass(frozen=True)
class Clip(_SameSize):
    """``y = min(max(x, low), high)``, which keeps actions within their bounds."""

    low: NDArray[np.float32]
    """Shape ``[size]``."""
    high: NDArray[np.float32]
    """Shape ``[size]``."""

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """From ``[N, size]`` to the same shape."""
        return np.clip(x, self.low, self.high)


@dataclass(frozen=True)
class Table:
    """Values of the cell that an observation lies in, see ``Binning``."""

    values: NDArray[np.float32]
    """Shape ``[cells, size]``."""
    groups: int
    closeness: tuple[float, ...]
    directions: int
    distances: tuple[float, ...]
    sectors: int
    observation_size: int

    @property
    def binning(self) -> Binning:
        """The cells."""
        return Binning(**{field.name: getattr(self, field.name) for field in fields(self)[1:]})

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """From ``[N, observation_size]`` to ``[N, size]``."""
        return self.values[self.binning(x)].astype(np.float64)

    def output_size(self, input_size: int | None) -> int:
        """Check the shapes, and give the number of values."""
        binning = self.binning
        if input_size is not None:
            raise ValueError("a table must come first")
        if self.values.ndim != 2 or len(self.values) != binning.cells:
            raise ValueError(
                f"values must have shape [{binning.cells}, size], got {self.values.shape}"
            )
        return int(self.values.shape[1])


@dataclass(frozen=True)
class Choice:
    """The action whose value is the greatest; of equal ones the first."""

    actions: NDArray[np.float32]
    """Shape ``[size, A]``."""

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """From ``[N, size]`` to ``[N, A]``."""
        return self.actions[x.argmax(-1)].astype(np.float64)

    def output_size(self, input_size: int | None) -> int:
        """Check the shapes, and give the size of an action."""
        size = len(self.actions) if input_size is None else input_size
        if self.actions.ndim != 2 or len(self.actions) != size:
            raise ValueError(f"actions must have shape [{size}, A], got {self.actions.shape}")
        return int(self.actions.shape[1])


Layer = Linear | LayerNorm | ReLU | Tanh | Scale | Clip | Table | Choice
KINDS: Final[Mapping[str, Callable[..., Layer]]] = {
    kind.__name__: kind for kind in (Linear, LayerNorm, ReLU, Tanh, Scale, Clip, Table, Choice)
}
"""The layers that a policy may have, by name."""


def check_layers(layers: Sequence[Layer]) -> tuple[int, int]:
    """Check that layers fit together; numbers of inputs and outputs."""
    if not layers or not isinstance(layers[0], Linear | Table):
        raise ValueError("layers must begin with a linear layer or a table")
    size: int | None = None
    for number, layer in enumerate(layers):
        try:
            size = layer.output_size(size)
        except ValueError as error:
            raise ValueError(f"layer {number}, {type(layer).__name__}: {error}") from error
        for name, value in arrays_of(layer).items():
            if not np.isfinite(value).all():
                raise ValueError(f"layer {number}, {type(layer).__name__}: {name} is not finite")
    first = layers[0]
    inputs = first.observation_size if isinstance(first, Table) else first.weight.shape[1]
    return int(inputs), int(size or 0)


def arrays_of(layer: Any) -> dict[str, NDArray[np.float32]]:
    """The weights of a layer by name."""
    values = {field.name: getattr(layer, field.name) for field in fields(layer)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def from_torch(modules: Iterable[Any]) -> list[Layer]:
    """Copy the layers of a PyTorch network, without ``Identity``."""
    from torch import nn

    layers: list[Layer] = []
    for module in modules:
        if isinstance(module, nn.Linear):
            weight = _array(module.weight)
            zeros = np.zeros(len(weight), np.float32)
            layers.append(Linear(weight, zeros if module.bias is None else _array(module.bias)))
        elif isinstance(module, nn.LayerNorm):
            if len(module.normalized_shape) != 1 or module.weight is None or module.bias is None:
                raise ValueError(f"LayerNorm must be of one dimension with bias, got {module!r}")
            eps = float(module.eps)
            layers.append(LayerNorm(_array(module.weight), _array(module.bias), eps))
        elif isinstance(module, nn.ReLU):
            layers.append(ReLU())
        elif isinstance(module, nn.Tanh):
            layers.append(Tanh())
        elif not isinstance(module, nn.Identity):
            layers += _scale(module, layers)
    return layers


def _scale(module: Any, before: Sequence[Layer]) -> list[Layer]:
    """Read an affine map, and where it is clipped, from its values at actions in [-1, 1]."""
    import torch

    linear = [layer for layer in before if isinstance(layer, Linear)]
    if linear and isinstance(before[-1], Tanh):
        size = len(linear[-1].bias)
        near, ends = 2.0**-10, torch.linspace(-1.0, 1.0, 5, dtype=torch.double)
        levels = torch.cat((ends, torch.tensor([-near, near], dtype=torch.double))).unsqueeze(-1)
        with torch.no_grad():
            try:
                outputs = copy.deepcopy(module).double()(levels.expand(7, size)).numpy()
            except (TypeError, RuntimeError, AttributeError):
                outputs = np.empty(0)
        if outputs.shape == (7, size):
            slope = (outputs[6] - outputs[5]) / (2 * near)
            scale = Scale(outputs[2].astype(np.float32), slope.astype(np.float32))
            clip = Clip(outputs.min(0).astype(np.float32), outputs.max(0).astype(np.float32))
            scaled = scale(levels.numpy())
            if np.allclose(scaled, outputs, rtol=1e-5):
                return [scale]
            if np.allclose(clip(scaled), outputs, rtol=1e-5):
                return [scale, clip]
    raise ValueError(
        f"layers must be among {sorted(KINDS)} and Identity, or map a Tanh to the bounds of "
        f"actions, got {module!r}"
    )


def _array(tensor: Any) -> NDArray[np.float32]:
    # A copy: training continues in the tensor.
    return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)


def _check_shape(name: str, value: NDArray[np.float32], size: int) -> None:
    if value.shape != (size,):
        raise ValueError(f"{name} must have shape [{size}], got {value.shape}")
