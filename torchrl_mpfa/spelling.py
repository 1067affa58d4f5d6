"""Errors about unknown names, with the nearest known one."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def unknown(word: str, name: object, known: Iterable[str]) -> str:
    """The error of an unknown name, with the nearest known one, or all of them if none is near.

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
