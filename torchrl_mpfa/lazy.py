"""Names of a package that are imported when they are first used."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any


def find(package: str, name: str, module_of: Mapping[str, str]) -> Any:
    """Return a public name of a package from its module, or a module of the package."""
    if name in module_of:
        return getattr(import_module(f"{package}.{module_of[name]}"), name)
    # A module is an attribute of its package only once it was imported.
    if "__path__" in vars(sys.modules[package]) and find_spec(f"{package}.{name}"):
        return import_module(f"{package}.{name}")
    raise AttributeError(f"module {package!r} has no attribute {name!r}")
