"""Parameters of a node by a table of defaults, whose types a command line need not match."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rcl_interfaces.msg import ParameterDescriptor

if TYPE_CHECKING:
    from collections.abc import Mapping

NOTHING: Final = "none"
"""Stands for an empty text, which a command line cannot give."""
_KINDS: Final = {str: "a text", float: "a number", int: "a whole number", bool: "true or false"}


def declare(node: Any, defaults: Mapping[str, Any]) -> None:
    """Declare parameters of any type; :func:`value_of` checks it, with an error that names them."""
    for name, default in defaults.items():
        node.declare_parameter(name, default, ParameterDescriptor(dynamic_typing=True))


def value_of(node: Any, name: str, defaults: Mapping[str, Any]) -> Any:
    """The value of a node's parameter, of the type of its default."""
    return checked(name, node.get_parameter(name).value, defaults[name])


def checked(name: str, value: Any, default: Any) -> Any:
    """A value of the type of a default; whole numbers will do for others."""
    kind = type(default)
    if kind is str and value in (None, NOTHING):
        return ""
    if kind is float and type(value) is int:
        return float(value)
    if kind is list:
        numbers = [] if isinstance(value, str) or not hasattr(value, "__iter__") else list(value)
        if not numbers or any(type(number) not in (int, float) for number in numbers):
            raise ValueError(f"{name} must be a list of numbers, got {value!r}")
        return [float(number) for number in numbers]
    if type(value) is not kind:
        raise ValueError(f"{name} must be {_KINDS[kind]}, got {value!r}")
    return value
