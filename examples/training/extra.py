"""Imported before all else by the scripts that need it.

A script ends here where the extra is missing. Warnings take one line, and PyTorch is imported when
something of it is first used: help and misspelt words are answered without it.
"""

from __future__ import annotations

import sys
import warnings
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any, TextIO

_missing = [
    name for name in ("hydra", "matplotlib", "pandas", "tqdm", "wandb") if not find_spec(name)
]
if _missing:
    raise SystemExit(
        f"this script needs {', '.join(_missing)}: install the extra 'examples', see Install in "
        "the README"
    )


class _Later(ModuleType):
    """PyTorch until something of it is used: it is executed then, in the same object."""

    def __getattr__(self, name: str) -> Any:
        spec = self.__spec__
        assert spec is not None and spec.loader is not None
        self.__class__ = ModuleType  # type: ignore[assignment]
        self.__path__ = spec.submodule_search_locations or []
        spec.loader.exec_module(self)
        return getattr(self, name)


def import_later(name: str) -> None:
    """Import a package when it is first used; :class:`importlib.util.LazyLoader` does so earlier.

    With that one, a second module that imports the package executes it.
    """
    spec = None if name in sys.modules else find_spec(name)
    if spec is not None:
        module = sys.modules[name] = module_from_spec(spec)
        module.__class__ = _Later
        # To import a part of it asks for this.
        del module.__path__


import_later("torch")

_PARTS = ("mpfa_envs", "torchrl_mpfa", "training")
_warned: set[str] = set()
_others = warnings.showwarning


def show_once(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Show a warning of the project once, in one line: it names a file of the user, not of ours."""
    if not set(_PARTS) & set(Path(filename).parts):
        _others(message, category, filename, lineno, file, line)
    elif str(message) not in _warned:
        _warned.add(str(message))
        print(f"warning: {message}", file=file or sys.stderr)


warnings.showwarning = show_once
