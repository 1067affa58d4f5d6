"""Argument checks and their errors, and the default random generator."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from numbers import Integral
from typing import TYPE_CHECKING, Any, Literal

import torch

if TYPE_CHECKING:
    from torch import Tensor

Level = float | Literal["mean"]
"""A reward, or ``"mean"``: the mean reward of the buffer."""
Rule = tuple[Callable[[Any], bool], str]
"""Test of a value, and in words what the value must be."""

POSITIVE: Rule = (lambda value: 0.0 < value < math.inf, "positive and finite")
NOT_NEGATIVE: Rule = (lambda value: 0.0 <= value < math.inf, "finite and not negative")
SHARE: Rule = (lambda value: 0.0 <= value <= 1.0, "in [0, 1]")
BELOW_ONE: Rule = (lambda value: 0.0 <= value < 1.0, "in [0, 1)")
ABOVE_ZERO: Rule = (lambda value: 0.0 < value <= 1.0, "in (0, 1]")
COUNT: Rule = (
    lambda value: (
        isinstance(value, Integral) and not isinstance(value, bool) and 1 <= int(value) < 2**31
    ),
    "an integer from 1 to 2147483647",
)
COUNT_OR_ZERO: Rule = (
    lambda value: not isinstance(value, bool) and COUNT[0](value + 1),
    "an integer from 0 to 2147483646",
)
LEVEL: Rule = (
    lambda x: x == "mean" or (not isinstance(x, bool | str | None) and math.isfinite(x)),
    "a finite number or 'mean'",
)


def seeded_generator(
    source: torch.Generator | None = None, device: torch.device | str = "cpu"
) -> torch.Generator:
    """Return a new generator on a device, seeded by another one, by default PyTorch's."""
    generator = torch.Generator(device)
    where = "cpu" if source is None else source.device
    generator.manual_seed(int(torch.randint(2**62, (), generator=source, device=where)))
    return generator


def generator_on(device: torch.device, source: torch.Generator | None) -> torch.Generator | None:
    """Return a generator for one call: the source on its own device, else one that it seeds.

    All state is in the source, so that a state saved on a GPU loads without one.
    """
    usable = source is None or source.device == device
    return source if usable else seeded_generator(source, device)


def kind_of(value: Any) -> str:
    """Return what a value is in words, as its text may have an address in memory."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return "None" if value is None else type(value).__name__


def check(rule: Rule, **values: Any) -> Any:
    """Return a value, or a tuple of several, as plain numbers; reject those against a rule by name.

    A saved state may hold Python's own numbers, not NumPy's.

    Raises:
        TypeError: If a value cannot be compared with a number.
        ValueError: If it is not allowed.

    Examples:
        >>> check(POSITIVE, lr=torch.tensor(0.5), tau=1)
        (0.5, 1)
        >>> check(POSITIVE, lr=0.1, tau=0.0)
        Traceback (most recent call last):
        ...
        ValueError: tau must be positive and finite, got 0.0
    """
    allowed, wanted = rule
    for name, value in values.items():
        try:
            inside = bool(allowed(value))
        except (TypeError, ValueError, RuntimeError):
            # A text, or a tensor of several numbers.
            raise TypeError(f"{name} must be a number, got {value!r}") from None
        if not inside:
            raise ValueError(f"{name} must be {wanted}, got {value!r}")
    plain = tuple(v.item() if hasattr(v, "item") else v for v in values.values())
    return plain if len(plain) > 1 else plain[0]


def keep(record: Any, **rules: Rule) -> None:
    """Put plain values in the fields of a dataclass, also of a frozen one, as :func:`check`."""
    for name, rule in rules.items():
        object.__setattr__(record, name, check(rule, **{name: getattr(record, name)}))


def unknown(word: str, name: object, known: Iterable[str]) -> str:
    """Return the error of an unknown name, with the nearest known one, or all if none is near.

    Examples:
        >>> unknown("method", "mpfa-per", ["mpfa_per", "per"])
        "unknown method 'mpfa-per': did you mean 'mpfa_per'?"
        >>> unknown("fusion", "x", ["fixed", "entropy"])
        "unknown fusion 'x': must be one of ['entropy', 'fixed']"
    """
    names = sorted(known)
    near = get_close_matches(str(name), names, n=1)
    cure = f"did you mean {near[0]!r}?" if near else f"must be one of {names}"
    return f"unknown {word} {name!r}: {cure}"


def rules_of(kind: type) -> dict[str, Rule]:
    """Return the rules in the metadata of a dataclass's fields.

    A field has its rule also where a subclass changes its default.
    """
    rules: dict[str, Rule] = {}
    for base in reversed(kind.__mro__):
        for name, entry in vars(base).get("__dataclass_fields__", {}).items():
            rules |= {name: entry.metadata["rule"]} if "rule" in entry.metadata else {}
    return rules


def check_counts(**counts: Any) -> Any:
    """Return integers from 1 to 2147483647 as :func:`check` does; reject anything else by name."""
    return check(COUNT, **counts)


def bounds(values: Tensor) -> tuple[float, float]:
    """Return the lowest and the highest value; both NaN if any value is."""
    low, high = values.aminmax()
    if not values.is_cpu:
        low, high = torch.stack((low, high)).cpu()  # Waits for the device once.
    # Comparing tensors would cost five times what comparing numbers does.
    return low.item(), high.item()


def check_index(index: Tensor, size: int) -> Tensor:
    """Return the slots without -1, by which TorchRL's writers mark what was not stored."""
    low, high = bounds(index) if index.numel() else (0, -1)
    if low < -1 or high >= size:
        raise IndexError(f"index must be in [0, {size}), got {low if low < -1 else high}")
    return index[index >= 0] if low == -1 else index


def check_shape(name: str, value: Any, shape: Sequence[int]) -> Tensor:
    """Return a tensor of this shape; reject anything else by name."""
    if isinstance(value, torch.Tensor) and value.shape == torch.Size(shape):
        return value
    got = f"shape {[*value.shape]}" if isinstance(value, torch.Tensor) else type(value).__name__
    raise ValueError(f"{name} must be a tensor of shape {[*shape]}, got {got}")


def as_mask(name: str, value: Any) -> Tensor:
    """Return booleans given as such or as 0 and 1; reject anything else by name."""
    if not isinstance(value, torch.Tensor):
        raise ValueError(f"{name} must be a tensor of booleans, got {type(value).__name__}")
    # A compiled program looks at no values.
    if value.dtype is torch.bool or torch.compiler.is_compiling():
        return value.bool()
    if bool((wrong := (value != 0) & (value != 1)).any()):
        raise ValueError(f"{name} must be booleans, or 0 and 1, got {value[wrong][0].item()}")
    return value != 0


def check_not_negative(name: str, value: Tensor) -> None:
    """Reject values that are negative or not finite, naming the first."""
    wrong = ~((value >= 0) & (value < math.inf))
    if bool(wrong.any()):
        raise ValueError(f"{name} must be finite and not negative, got {value[wrong][0].item()}")
