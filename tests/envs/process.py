"""Code in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import mpfa_envs

ROOT = Path(mpfa_envs.__file__).parents[1]


def run(code: str, *words: str, without: Iterable[str] = (), **variables: str) -> str:
    """The output of code where some packages are not installed."""
    hidden = "".join(f"sys.modules[{name!r}] = None\n" for name in without)
    return subprocess.run(
        [sys.executable, "-c", f"import sys\n{hidden}{code}", *words],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT.parent}", **variables},
    ).stdout
