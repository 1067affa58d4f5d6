"""Saved states as data: what each entry must be, and the one check that reads it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Entry:
    """An entry of a saved state."""

    name: str
    holds: Callable[[Any], bool | Tensor] = lambda _: True
    """Whether a value can be; of a tensor, which of its numbers, counted from the first."""
    wanted: str = ""
    """The same in words."""
    dtype: torch.dtype | None = None
    """Of a tensor; None for anything else."""
    shape: tuple[int | None, ...] = ()
    """Of a tensor; None: any length."""


def exactly(name: str, value: Any, why: str = "") -> Entry:
    """An entry that must be equal to this, and the reason in words."""
    return Entry(name, lambda found: bool(found == value), f"{value!r}{why}")


def number(name: str, *, high: float = math.inf, optional: bool = False) -> Entry:
    """An entry that must be a finite number from 0 to ``high``, or None where it is optional."""

    def holds(value: Any) -> bool:
        if value is None:
            return optional
        plain = isinstance(value, int | float) and not isinstance(value, bool)
        return plain and 0 <= value <= high and value < math.inf

    words = "a finite number of at least 0" if high == math.inf else f"in [0, {high:g}]"
    return Entry(name, holds, words)


def finite(name: str) -> Entry:
    """An entry that must be a finite number."""
    return Entry(name, lambda v: isinstance(v, int | float) and math.isfinite(v), "a finite number")


def count(name: str, *, high: int | None = None) -> Entry:
    """An entry that must be an integer from 0 to ``high``."""
    words = "an integer of at least 0" if high is None else f"in [0, {high}]"
    return Entry(
        name,
        lambda value: type(value) is int and 0 <= value <= (value if high is None else high),
        words,
    )


def generator(name: str) -> Entry:
    """An entry that must be the state and the device of a generator, or None."""

    def holds(found: Any) -> bool:
        try:
            if found is not None:
                state, device = found
                torch.Generator(device=device).set_state(state)
        except (TypeError, ValueError, RuntimeError):
            return False
        return True

    return Entry(name, holds, "the state of a generator")


def check_entries(
    part: str, state: Any, entries: Iterable[Entry], *, missing: type[Exception] = KeyError
) -> None:
    """Reject the saved state of a part, by entry and value, that is not as described.

    Raises:
        KeyError: If an entry is missing; or the exception that is given for it.
        ValueError: If the state is no mapping, or an entry is not what it must be.

    Examples:
        >>> check_entries("writer", {"_cursor": -1}, [count("_cursor")])
        Traceback (most recent call last):
        ...
        ValueError: '_cursor' of the saved writer must be an integer of at least 0, got -1
    """
    if not isinstance(state, Mapping):
        raise ValueError(f"the saved {part} must be a mapping, got {type(state).__name__}")
    for each in entries:
        if each.name not in state:
            raise missing(f"{each.name!r} is missing in the saved {part}")
        value = state[each.name]
        if each.dtype is not None and not _has_form(value, each):
            shape = ", ".join("M" if size is None else str(size) for size in each.shape)
            found = _form(value) if isinstance(value, Tensor) else value
            raise wrong(part, each.name, f"{each.dtype} of shape [{shape}]", found)
        holds = each.holds(value)
        if not isinstance(holds, Tensor):
            if not holds:
                raise wrong(part, each.name, each.wanted, value)
        elif not bool(holds.all()):
            bad = value.reshape(-1)[: holds.numel()][~holds.reshape(-1)][0].item()
            raise wrong(part, each.name, each.wanted, bad)


def wrong(part: str, name: str, wanted: str, found: object) -> ValueError:
    """The error of an entry that is not what it must be."""
    return ValueError(f"{name!r} of the saved {part} must be {wanted}, got {found!r}")


def _has_form(value: Any, entry: Entry) -> bool:
    return (
        isinstance(value, Tensor)
        and value.dtype is entry.dtype
        and value.ndim == len(entry.shape)
        and all(size in (None, own) for size, own in zip(entry.shape, value.shape, strict=True))
    )


def _form(value: Tensor) -> str:
    return f"{value.dtype} of shape {[*value.shape]}"
