"""A word for the user whose setting does not exist: the nearest one that does."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from settings import GROUPS, TrainSettings


def known_settings(settings: Any = None, prefix: str = "") -> Iterator[str]:
    """Every setting by its dotted name."""
    for entry in fields(TrainSettings if settings is None else settings):
        if not prefix and entry.name in ("hydra", "defaults"):
            continue
        name = prefix + entry.name
        yield name
        default = entry.default_factory() if callable(entry.default_factory) else entry.default
        if is_dataclass(default):
            yield from known_settings(default, f"{name}.")


def check_overrides(arguments: Sequence[str]) -> None:
    """Refuse settings that do not exist, before anything starts.

    Args:
        arguments: The command line.

    Raises:
        SystemExit: If a setting or a choice is unknown; its message names the nearest one.
    """
    texts = [text for text in arguments if "=" in text and not text.startswith("-")]
    known = list(known_settings())
    for override in OverridesParser.create().parse_overrides(texts):
        key = override.key_or_group
        if key.startswith("hydra"):
            continue
        if key not in known:
            raise SystemExit(f"unknown setting {key!r}{_nearest(key, known)}")
        choices = GROUPS.get(key)
        if choices is not None and not override.is_sweep_override():
            value = str(override.value())
            if value not in choices:
                raise SystemExit(
                    f"unknown choice {value!r} of {key!r}{_nearest(value, choices)}; "
                    f"there are: {', '.join(choices)}"
                )


def _nearest(word: str, known: Sequence[str] | dict[str, Any]) -> str:
    # Most mistakes are a slip of the pen, or a setting without the section it is in.
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    inside = [name for name in known if name.split(".")[-1] == word.split(".")[-1]]
    found = inside[:1] or near
    return f": did you mean {found[0]!r}?" if found else ""
