"""Compiles the loops of replay when a wheel is built; without a compiler the wheel has none."""

from __future__ import annotations

import os
import runpy
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


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
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform}"
        build_data["force_include"][str(library)] = f"torchrl_mpfa/native/{library.name}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Leave no library in the source."""
        if hasattr(self, "_library"):
            self._library.unlink(missing_ok=True)
