"""Rules of settings next to their defaults, and the names of settings in errors."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import field, fields, is_dataclass
from typing import Any

from torchrl_mpfa.checks import Rule


def setting(default: Any, rule: Rule) -> Any:
    """Return a field of settings with a rule for its values; null is always allowed."""
    return field(default=default, metadata={"rule": rule})


def at_least(least: float) -> Rule:
    """Return the rule: finite, and not below a bound."""
    return lambda value: least <= value < math.inf, f"at least {least:g}"


def up_to(most: int, *, why: str = "") -> Rule:
    """Return the rule of a count that a machine has room for."""
    return lambda value: 1 <= value <= most, f"from 1 to {most}{why}"


def between(low: float, high: float, words: str) -> Rule:
    """Return the rule of a closed interval."""
    return lambda value: low <= value <= high, words


def choice(*names: str) -> Rule:
    """Return the rule: one of these names."""
    return lambda value: value in names, f"one of {', '.join(names)}"


NAME: Rule = (
    lambda value: re.fullmatch(r"[\w.+-]+", value) is not None,
    "letters, digits and any of . _ + -, as it names a folder",
)
WORD: Rule = (lambda value: bool(value.strip()), "not be empty")


def settings_by_name(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each setting, its dotted name and its value."""
    for entry in fields(settings):
        if not prefix and entry.name in ("hydra", "defaults"):
            continue
        value, name = getattr(settings, entry.name), prefix + entry.name
        if is_dataclass(value):
            yield from settings_by_name(value, f"{name}.")
        else:
            yield name, value


def check_rules(settings: Any, rules: Mapping[str, Rule], prefix: str) -> None:
    """Raise if a rule does not allow a value."""
    for name, rule in rules.items():
        value, (allowed, wanted) = getattr(settings, name), rule
        if value is not None and not allowed(value):
            must = wanted if rule is WORD else f"be {wanted}"
            raise ValueError(f"{prefix}{name} must {must}, got {value!r}")


@contextmanager
def named(name: str) -> Iterator[None]:
    """Put a name before the error of a part, in one line."""
    try:
        yield
    except (TypeError, ValueError, OSError) as error:
        raise ValueError(f"{name}{' '.join(str(error).split())}") from error
