"""Compiles the loops of replay, with any C compiler that is there."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

SOURCE = Path(__file__).with_name("replay.c")
# Sums of products as they are written: a fused product would be rounded otherwise.
_OPTIONS = ("-O3", "-ffp-contract=off", "-fPIC", "-shared")


_LONGEST = 120
"""Time in which a compiler must be done [s]."""


def library_name() -> str:
    """Return the name of the library's file, which follows from source and processor."""
    digest = hashlib.sha256(SOURCE.read_bytes() + " ".join(_OPTIONS).encode()).hexdigest()
    # Machines of several kinds may share the folder.
    return f"replay-{platform.machine()}-{digest[:16]}.so"


def compile_library(target: Path) -> str | None:
    """Compile the source to a shared library, whole or not at all; return what went wrong, if any.

    The compiler is that of the environment variable ``CC``, else ``cc``, ``gcc`` or ``clang``.
    """
    names = [os.environ.get("CC", "").split(), ["cc"], ["gcc"], ["clang"]]
    compiler = next((words for words in names if words and shutil.which(words[0])), None)
    if compiler is None:
        return "there is no C compiler, neither CC, cc, gcc nor clang"
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        made = Path(folder) / target.name
        command = [*compiler, *_OPTIONS, str(SOURCE), "-o", str(made), "-lm"]
        done = subprocess.run(command, capture_output=True, check=False, timeout=_LONGEST)
        if done.returncode:
            return f"{' '.join(compiler)} failed: {done.stderr.decode(errors='replace')[-200:]}"
        os.replace(made, target)
    return None
