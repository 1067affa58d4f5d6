"""Import both packages on the oldest Python that they admit, where nothing is installed for it.

    python3.10 .ci/import_on_oldest.py

What they import from elsewhere is made up: what is tried is the language and its own library.
"""

from __future__ import annotations

import importlib
import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = {"torchrl_mpfa": ROOT, "mpfa_envs": ROOT / "envs"}
# Modules of one optional package or system, which a user imports by name.
_LEFT_OUT = ("mpfa_envs.ros.launch",)


class _Kind(type):
    """Class of made-up classes: whatever is asked of one is another one."""

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__") and name.endswith("__"):
            raise AttributeError(name)
        kind = _Kind(name, (), {})
        setattr(cls, name, kind)
        return kind

    def __call__(cls, *arguments: Any, **named: Any) -> Any:
        # As a decorator it leaves the function as it is.
        plain = len(arguments) == 1 and not named and callable(arguments[0])
        return arguments[0] if plain else _Kind(cls.__name__, (), {})

    def __getitem__(cls, key: Any) -> Any:
        return cls

    def __or__(cls, other: Any) -> Any:
        return cls

    __ror__ = __or__

    def __iter__(cls) -> Any:
        return iter(())

    def __float__(cls) -> float:
        return 1.0

    def __index__(cls) -> int:
        return 1

    def __len__(cls) -> int:
        return 1

    def __fspath__(cls) -> str:
        return str(ROOT)

    def __lt__(cls, other: Any) -> bool:
        return True

    __gt__ = __le__ = __ge__ = __lt__

    def _number(cls, *others: Any) -> Any:
        return cls

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = _number
    __rtruediv__ = __pow__ = __neg__ = _number


class _MadeUp(ModuleType):
    """Module that has every name."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name.endswith("__"):
            raise AttributeError(name)
        kind = _Kind(name, (), {"__module__": self.__name__})
        setattr(self, name, kind)
        return kind


class _Finder(MetaPathFinder, Loader):
    """Finds what is neither in the standard library nor in the packages."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> ModuleSpec | None:
        top = name.partition(".")[0]
        here = top in sys.stdlib_module_names or top in PACKAGES
        return None if here else ModuleSpec(name, self, is_package=True)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _MadeUp(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Leave the module without code."""


def main() -> None:
    """Import every module of both packages."""
    sys.path[:0] = [str(folder) for folder in PACKAGES.values()]
    sys.meta_path.insert(0, _Finder())
    count = 0
    for package, folder in PACKAGES.items():
        for path in sorted((folder / package).rglob("*.py")):
            name = ".".join(path.relative_to(folder).with_suffix("").parts)
            name = name.removesuffix(".__init__")
            if not name.startswith(_LEFT_OUT):
                importlib.import_module(name)
                count += 1
    print(f"imported {count} modules on Python {sys.version.partition(' ')[0]}")


if __name__ == "__main__":
    main()
