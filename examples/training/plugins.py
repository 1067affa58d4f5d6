"""Plugins: a file of one's own that is imported first, and registers names."""

from __future__ import annotations

import os
import sys
import traceback
from argparse import ArgumentParser
from collections.abc import Iterable, Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

from training.files import digest

_WORD = "plugin="


def load_plugin(path: str | Path) -> str:
    """Import a plugin, unless this process has done so.

    Returns:
        Its absolute path.

    Raises:
        ValueError: If there is no such file, an error ended it, or what it registered cannot be.
    """
    file = Path(path).resolve()
    if not os.path.isfile(file) or file.suffix != ".py":
        raise ValueError(f"plugin must be a Python file, got {path}")
    # By its name, as processes of Ray look for what it defines.
    loaded, sha256 = sys.modules.get(file.stem), digest(file)
    if loaded is not None and getattr(loaded, "PLUGIN", None) == sha256:
        return str(file)
    if loaded is not None and Path(getattr(loaded, "__file__", None) or "").resolve() != file:
        raise ValueError(f"plugin must have a name that no module has, got {path}")
    spec = spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[file.stem] = module
    try:
        spec.loader.exec_module(module)
        _check_methods()
    except Exception as error:
        del sys.modules[file.stem]
        lines = [
            frame.lineno
            for frame in traceback.extract_tb(error.__traceback__)
            if frame.filename == str(file)
        ]
        where = f"{path}:{lines[-1]}" if lines else str(path)
        raise ValueError(f"plugin {where}: {type(error).__name__}: {error}") from error
    module.PLUGIN = sha256  # type: ignore[attr-defined]
    return str(file)


def _check_methods() -> None:
    """Raise if a method is registered by another name than its own."""
    from torchrl_mpfa.methods import ALIASES, METHODS

    for name, method in METHODS.items():
        if method.name != ALIASES.get(name, name) and method.name != name:
            raise ValueError(f"METHODS[{name!r}] must have this name, got {method.name!r}")


def plugin_words(arguments: Iterable[str]) -> list[str]:
    """Return the words of a command line that name a plugin.

    Examples:
        >>> plugin_words(["seed=1", "plugin=mine.py"])
        ['plugin=mine.py']
    """
    return [text for text in arguments if text.startswith(_WORD)]


def with_plugin(
    arguments: Sequence[str], plugin: str | None = None
) -> tuple[list[str], str | None]:
    """Load the plugin that settings of ``train.py`` name.

    Args:
        arguments: The settings; ``--plugin FILE`` is the same as ``plugin=FILE``.
        plugin: That of another option.

    Returns:
        The settings, and the plugin's absolute path, which they have.
    """
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--plugin", action="append", default=[plugin] if plugin else [])
    options, words = parser.parse_known_args(arguments)
    named = [word.removeprefix(_WORD) for word in plugin_words(words)]
    paths = {load_plugin(file) for file in [*options.plugin, *named]}
    if not paths:
        return words, None
    if len(paths) > 1:
        raise ValueError(f"plugin must be one file, got {' and '.join(sorted(paths))}")
    (path,) = paths
    return [*(word for word in words if not word.startswith(_WORD)), f"{_WORD}{path}"], path
