"""What bad input is refused by, and the generator that nothing random goes without."""

from __future__ import annotations

import math
from numbers import Integral

import torch
from torch import Tensor


def seeded_generator() -> torch.Generator:
    """A generator of its own, seeded by the global one so that ``torch.manual_seed`` rules it."""
    generator = torch.Generator()
    generator.manual_seed(int(torch.randint(2**62, ())))
    return generator


def check_range(name: str, value: float, *, low: float) -> None:
    """Refuse what is no number, below ``low`` or not finite."""
    try:
        inside = low <= value < math.inf
    except TypeError:
        raise TypeError(f"{name} must be a number, got {value!r}") from None
    if not inside:
        raise ValueError(f"{name} must be finite and at least {low}, got {value}")


def check_counts(**counts: object) -> None:
    """Refuse, by name, what is not a positive integer.

    Examples:
        >>> check_counts(width=64, layers=0)
        Traceback (most recent call last):
        ...
        ValueError: layers must be a positive integer, got 0
    """
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
            raise ValueError(f"{name} must be a positive integer, got {value!r}")


def bounds(values: Tensor) -> tuple[float, float]:
    """Lowest and highest value; both NaN if any is."""
    low, high = values.aminmax()
    # Comparing tensors would cost five times what comparing numbers does.
    return low.item(), high.item()


def check_index(index: Tensor, size: int) -> Tensor:
    """The slots without -1, by which TorchRL's writers mark what was not stored."""
    low, high = bounds(index) if len(index) else (0, -1)
    if low < -1 or high >= size:
        raise IndexError(f"index must be in [0, {size}), got {low if low < -1 else high}")
    return index[index >= 0] if low == -1 else index


def check_finite(name: str, value: Tensor) -> None:
    """Refuse values that are negative or not finite, naming the first."""
    wrong = ~((value >= 0) & (value < math.inf))
    if bool(wrong.any()):
        raise ValueError(f"{name} must be finite and not negative, got {value[wrong][0].item()}")
