"""Compiles the loops of replay, with any C compiler that is there."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

SOURCE = Path(__file__).with_name("replay.c")
# Sums of products as they are written: a fused product would be rounded otherwise.
_OPTIONS = ("-O3", "-ffp-contract=off", "-fPIC", "-shared")


def library_name() -> str:
    """Return the name of the library's file, which follows from the source."""
    digest = hashlib.sha256(SOURCE.read_bytes() + " ".join(_OPTIONS).encode()).hexdigest()
    return f"replay-{digest[:16]}.so"


def compile_library(target: Path) -> bool:
    """Compile the source to a shared library, whole or not at all; return True if that went well.

    The compiler is that of the environment variable ``CC``, else ``cc``, ``gcc`` or ``clang``.
    """
    names = [os.environ.get("CC", "").split(), ["cc"], ["gcc"], ["clang"]]
    compiler = next((words for words in names if words and shutil.which(words[0])), None)
    if compiler is None:
        return False
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        made = Path(folder) / target.name
        command = [*compiler, *_OPTIONS, str(SOURCE), "-o", str(made), "-lm"]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            return False
        os.replace(made, target)
    return True
