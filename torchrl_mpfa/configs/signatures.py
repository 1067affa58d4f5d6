"""Hydra configurations made from signatures: every argument is a field, with the same default."""

from __future__ import annotations

import inspect
from collections.abc import Collection, Iterator
from dataclasses import field, fields, make_dataclass
from typing import Any, Optional

from torchrl_mpfa.signals import Signal

_STARS = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
_PLAIN = {"bool": bool, "int": int, "float": float, "str": str}


def config_of(
    made: Any,
    base: type,
    target: str,
    *,
    name: str = "",
    required: Any = "???",
    leave_out: Collection[str] = (),
    **defaults: Any,
) -> type[Any]:
    """A configuration of a class, with the arguments that it passes on, or of a function.

    The fields of ``base``, a configuration of TorchRL, stay as they are. Hydra calls ``target``;
    ``required`` is the default of arguments that have none.
    """
    known = {each.name for each in fields(base)} | set(leave_out)
    entries: dict[str, tuple[str, Any, Any]] = {}
    for parameter in _parameters(made):
        if parameter.name in known and parameter.name not in defaults:
            continue
        default = required if parameter.default is parameter.empty else parameter.default
        default = defaults.get(parameter.name, default)
        kind = _type_of(parameter.annotation)
        # An interpolation, or a word that stands for a number.
        kind = Any if isinstance(default, str) and kind is not str else kind
        entries.setdefault(parameter.name, (parameter.name, kind, field_default(default)))
    path = [("_target_", str, target), ("_convert_", str, "all")]
    title = name or f"{made.__name__}Config"
    config = make_dataclass(title, [*entries.values(), *path], bases=(base,))
    config.__doc__ = f"Configuration of ``{made.__name__}``, which describes the fields."
    config.__module__ = "torchrl_mpfa.configs"
    return config


def field_default(value: Any) -> Any:
    """A default as a configuration can hold it: a new list for what is a sequence."""
    if not isinstance(value, list | tuple):
        return value
    plain = [each.name if isinstance(each, Signal) else each for each in value]
    return field(default_factory=lambda: list(plain))


def _parameters(made: Any) -> Iterator[inspect.Parameter]:
    """Parameters of a function, or of a class and of those that it passes keywords on to."""
    functions = [made]
    if inspect.isclass(made):
        functions = [vars(each)["__init__"] for each in made.__mro__ if "__init__" in vars(each)]
    for function in functions:
        parameters = inspect.signature(function).parameters.values()
        yield from (p for p in parameters if p.name != "self" and p.kind not in _STARS)
        if all(p.kind is not p.VAR_KEYWORD for p in parameters):
            return


def _type_of(annotation: Any) -> Any:
    """The types that Hydra checks; any value for the others."""
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", "")
    plain = _PLAIN.get(text.removesuffix(" | None"))
    if plain is None:
        return Any
    return Optional[plain] if text.endswith("None") else plain  # noqa: UP045
