"""Imports that wait for the import of something else."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec


def after_import(awaited: str, module: str) -> None:
    """Import a module as soon as another one is imported, or now if that is there already."""
    if sys.modules.get(awaited) is not None:
        import_module(module)
    elif not any(isinstance(each, _Waiting) and each.module == module for each in sys.meta_path):
        sys.meta_path.insert(0, _Waiting(awaited, module))


class _Waiting(MetaPathFinder):
    """Is asked first where to find a module, and has another one imported after it."""

    def __init__(self, awaited: str, module: str) -> None:
        self.awaited = awaited
        self.module = module
        self._searching = False

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        """Leave the search to the other finders."""
        if fullname != self.awaited or self._searching:
            return None
        self._searching = True
        try:
            spec = find_spec(fullname)
        finally:
            self._searching = False
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_import(loaded: Any) -> None:
                execute(loaded)
                # Only now: to ask whether a module is there does not import it.
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                import_module(self.module)

            setattr(spec.loader, "exec_module", execute_and_import)  # noqa: B010
        return spec
