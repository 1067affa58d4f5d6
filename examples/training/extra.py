"""Imported before all else by the scripts that need it: warnings in one line, and the extra.

A script ends here where the extra is missing.
"""

from __future__ import annotations

import sys
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import TextIO

_missing = [
    name for name in ("hydra", "matplotlib", "pandas", "tqdm", "wandb") if not find_spec(name)
]
if _missing:
    raise SystemExit(
        f"this script needs {', '.join(_missing)}: install the extra 'examples', see Install in "
        "the README"
    )

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
