"""Settings in a file, ``settings=FILE``: a line ``NAME: VALUE`` for each, as ``tune.py`` writes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

_WORD = "settings="
_QUOTED = r"""'(?:\\.|[^'])*'|"(?:\\.|[^"])*\""""
_SPECIAL = r"[^\x00-\x7f]|[#!&;<>^`~]"
"""Characters that Hydra reads in quotes only."""


def lines_of(arguments: Sequence[str]) -> tuple[str, list[str]]:
    """Return the file of settings of a command line, empty without one, and its settings.

    Settings that the command line has are left out.
    """
    files = [text.removeprefix(_WORD) for text in arguments if text.startswith(_WORD)]
    if len(files) > 1:
        raise ValueError(f"settings must be one file, got {' and '.join(files)}")
    if not files:
        return "", []
    given = {text.partition("=")[0] for text in arguments}
    found = read_names(Path(files[0]))
    return files[0], [f"{n}={as_text(value)}" for n, value in found.items() if n not in given]


def with_lines(arguments: Sequence[str]) -> list[str]:
    """Return a command line for Hydra: a file of settings is replaced by its settings."""
    _, lines = lines_of(arguments)
    words = [word for text in arguments for word in (lines if text.startswith(_WORD) else [text])]
    return [quoted(word) for word in words]


def quoted(text: str) -> str:
    """Put the words of a setting in quotes if Hydra cannot read them without.

    Examples:
        >>> quoted("run_dir=/runs/ünï"), quoted("seed=1"), quoted("names=[a,ü,'ï']")
        ("run_dir='/runs/ünï'", 'seed=1', "names=[a,'ü','ï']")
    """
    name, equals, value = text.partition("=")
    if not equals or text.startswith("-"):
        return text
    # A colon ends a key of a mapping, and is part of a word elsewhere.
    word = rf"(?:[^,\[\]{{}}()'\"{':' if '{' in value else ''}])+"

    def in_quotes(found: re.Match[str]) -> str:
        part = found.group()
        return f"'{part}'" if part[0] not in "'\"" and re.search(_SPECIAL, part) else part

    return name + equals + re.sub(f"{_QUOTED}|{word}", in_quotes, value)


def read_names(path: Path) -> dict[str, Any]:
    """Read a YAML file whose keys are the dotted names of settings."""
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    try:
        found = OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, YAMLError, OmegaConfBaseException, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}") from error
    if not isinstance(found, dict) or not found:
        raise ValueError(f"{path} must have a line NAME: VALUE for each setting")
    return {str(name): value for name, value in found.items()}


def as_text(value: Any) -> str:
    """Write a value as on the command line.

    Examples:
        >>> as_text([{"world": "A", "actions": 500}]), as_text(None), as_text(1e-4)
        ('[{world:A,actions:500}]', 'null', '0.0001')
    """
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_text, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{name}:{as_text(each)}" for name, each in value.items()) + "}"
    return str(value)
