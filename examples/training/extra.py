"""Imported before all else by the scripts that need it.

A script ends here where the extra is missing. Warnings take one line, and PyTorch is imported when
something of it is first used: help and misspelt words are answered without it. Garbage is collected
less often, and what was imported is not taken apart at the end.
"""

from __future__ import annotations

import atexit
import gc
import logging
import os
import sys
import warnings
from contextlib import suppress
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from threading import RLock
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


# Imports make 600,000 objects that stay. By default they are searched through again and again,
# which takes a fifth of the imports' time.
gc.set_threshold(100_000, 50, 50)
_status: list[int] = []
_is_first = "multiprocessing.util" not in sys.modules
"""``_end`` would come before what multiprocessing, imported first, has registered for its end."""


def end_with(status: int) -> None:
    """Have the process end with a status once all that was registered for its end is done."""
    if _is_first:
        _status.append(status)


@atexit.register  # Before all others, hence called after them.
def _end() -> None:
    """End the process: to take all modules apart would take seconds."""
    if _status:
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(_status[-1])


class _Later(ModuleType):
    """A package until something of it is used: it is executed then, in the same object."""

    def __getattr__(self, name: str) -> Any:
        execute(self)
        return getattr(self, name)


_lock = RLock()
_begun: set[str] = set()


def execute(module: ModuleType) -> None:
    """Execute a package that is imported later; other threads wait for it."""
    with _lock:
        if isinstance(module, _Later) and module.__name__ not in _begun:
            assert module.__spec__ is not None and module.__spec__.loader is not None
            _begun.add(module.__name__)
            module.__spec__.loader.exec_module(module)
            module.__class__ = ModuleType  # type: ignore[assignment]
        elif isinstance(module, _Later):
            # The package itself asks, in the midst of its import.
            raise AttributeError(f"module {module.__name__!r} is not imported as far as that yet")


class _Parts(MetaPathFinder, Loader):
    """Executes a package before a part of it is imported, which it may import itself."""

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        """Find what the package imported; the usual finders find the rest."""
        package = sys.modules.get(fullname.partition(".")[0])
        if isinstance(package, _Later) and package.__name__ not in _begun:
            execute(package)
            if (module := sys.modules.get(fullname)) is not None:
                # Of a module that came meanwhile it is the module's own that counts.
                self.spec, module.__spec__ = module.__spec__, ModuleSpec(fullname, self)
                return module.__spec__
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return what is there already."""
        return sys.modules[spec.name]

    def exec_module(self, module: ModuleType) -> None:
        """Leave it as it is."""
        module.__spec__ = self.spec


def import_later(name: str) -> None:
    """Import a package when it is first used; :class:`importlib.util.LazyLoader` does so earlier.

    With that one, a second module that imports the package executes it.
    """
    spec = None if name in sys.modules else find_spec(name)
    if spec is not None:
        module = sys.modules[name] = module_from_spec(spec)
        module.__class__ = _Later
        sys.meta_path.insert(0, _Parts())


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
