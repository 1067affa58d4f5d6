"""Compiles the loops of replay when a wheel is built; without a compiler the wheel has none."""

from __future__ import annotations

import os
import re
import runpy
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import platform_tags

_OLDEST = 17
"""Version 2.17 of glibc is the oldest that installers ask for on every processor."""


def platform_tag(library: bytes, platforms: Iterable[str]) -> str:
    """Name the oldest platform on which a compiled library loads, of this machine's kind.

    Args:
        library: The file. With glibc it names the version that brought each symbol, as
            ``GLIBC_2.29``.
        platforms: Tags of this machine, the newest of a kind first.

    Returns:
        ``manylinux_2_N`` with the processor. Of a musl or a macOS this machine's own version, which
        is what the compiler had; of another Linux ``linux`` with the processor.
    """
    own = sorted(platforms, key=lambda tag: tag.startswith("linux_"))[0]
    versions = [int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)", library)]
    # A name without a number asks for a feature of the loader, of which no version is told here.
    if not versions or re.search(rb"GLIBC_[A-Z]", library):
        return own
    return re.sub(r"^manylinux_2_\d+", f"manylinux_2_{max(*versions, _OLDEST)}", own)


class CompiledLoops(BuildHookInterface[Any]):
    """Adds the compiled library to a wheel, which is then one for this platform."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the library, but for an editable install or a wheel for any processor."""
        if version == "editable" or os.environ.get("TORCHRL_MPFA_NATIVE") == "0":
            return
        folder = Path(self.root) / "torchrl_mpfa" / "native"
        build = runpy.run_path(str(folder / "build.py"))
        library = folder / build["library_name"]()
        if (reason := build["compile_library"](library)) is not None:
            self.app.display_warning(f"replay is compiled at its first use: {reason}")
            return
        self._library = library
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform_tag(library.read_bytes(), platform_tags())}"
        build_data["force_include"][str(library)] = f"torchrl_mpfa/native/{library.name}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Leave no library in the source."""
        if hasattr(self, "_library"):
            self._library.unlink(missing_ok=True)
