"""Checks of arguments, with errors that name the argument and the value."""

from __future__ import annotations

import math
from collections.abc import Iterable
from difflib import get_close_matches
from operator import index
from typing import Any, Final, get_args

MOST: Final = 100_000
"""Largest count by default: robots, episodes, worlds, rays and scans are made one by one or held at
once, and a typing error must not take all time or memory."""


def check_number(name: str, value: Any) -> float:
    """A finite number."""
    if isinstance(value, (bool, str, bytes)):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    return number


def plain(value: Any) -> Any:
    """A number of Python's own in the place of one of NumPy's, which no saved state may hold."""
    return value.item() if hasattr(value, "item") else value


def keep(record: Any, *names: str) -> None:
    """Put plain numbers in the fields of a dataclass, also of a frozen one."""
    for name in names:
        object.__setattr__(record, name, plain(getattr(record, name)))


def all_finite(values: Iterable[Any]) -> bool:
    """Return True if all are finite numbers, which text and truth values are not."""
    try:
        return all(math.isfinite(value) and not isinstance(value, bool) for value in values)
    except (TypeError, ValueError, OverflowError):
        return False


def check_positive(name: str, value: Any) -> float:
    """A finite number above zero."""
    number = check_number(name, value)
    if number <= 0.0:
        raise ValueError(f"{name} must be positive, got {value!r}")
    return number


def check_not_negative(name: str, value: Any) -> float:
    """A finite number that is zero or above."""
    number = check_number(name, value)
    if number < 0.0:
        raise ValueError(f"{name} must not be negative, got {value!r}")
    return number


def check_share(name: str, value: Any) -> float:
    """A number in [0, 1]."""
    number = check_number(name, value)
    if not 0.0 <= number <= 1.0:
        raise ValueError(f"{name} must be in [0, 1], got {value!r}")
    return number


def check_count(name: str, value: Any, *, least: int = 1, most: float = MOST) -> int:
    """An integer from ``least`` to ``most``."""
    try:
        number = None if isinstance(value, bool) else index(value)
    except TypeError:
        number = None
    if number is None or number < least:
        what = "a positive integer" if least == 1 else f"an integer of at least {least}"
        raise ValueError(f"{name} must be {what}, got {value!r}")
    if number > most:
        raise ValueError(f"{name} must be at most {most}, got {value!r}")
    return number


def check_choice(name: str, value: Any, kinds: Any) -> Any:
    """One of the values of a ``Literal``."""
    if value not in get_args(kinds):
        raise ValueError(f"{name} must be one of {get_args(kinds)}, got {value!r}")
    return value


def check_seed(value: Any) -> int:
    """An integer of any size that is not negative."""
    return check_count("seed", value, least=0, most=math.inf)


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """A question about the nearest known name; empty if none is near."""
    near = get_close_matches(str(name), list(known), n=1)
    return f"did you mean {near[0]!r}?" if near else ""
