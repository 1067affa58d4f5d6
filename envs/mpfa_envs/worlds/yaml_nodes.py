"""Reading YAML files with errors that name the line."""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final

import yaml

from mpfa_envs.checks import did_you_mean
from mpfa_envs.files import cause_of, read_file

_LARGEST_FILE: Final = 1_000_000
"""Longest text that is read [bytes]."""
_MOST_ENTRIES: Final = 1000
"""Longest list: with aliases, a line of ten letters can stand for a hundred corners."""
_IMAGE: Final = re.compile(r"""^[\ufeff \t{]*["']?image["']?[ \t]*:""", re.MULTILINE)
"""Key that only the YAML file of a map has, which other tools write."""


KINDS: Final = (
    "a .yaml or .yml file, which is a world or names the image of a ROS map, or a .world or .sdf "
    "file of Gazebo, which may be compressed (.gz)"
)
"""Files that are read."""


class WorldFileError(ValueError):
    """A file does not describe a world; the message names the file and the line."""


def _decoded(content: bytes) -> str:
    """Read UTF-8, or else what has a mark of UTF-16 or an older encoding, as in a comment."""
    try:
        return content.decode()
    except UnicodeDecodeError:
        marks = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
        return content.decode("utf-16" if content.startswith(marks) else "cp1252", "replace")


def read_number(text: str) -> float:
    """Read a number, NaN for other text: Python also accepts ``1_0`` and non-ASCII digits."""
    try:
        return float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        return math.nan


def is_map(root: yaml.Node | None) -> bool:
    """Return True if a file describes a map of ROS, which names an image."""
    return isinstance(root, yaml.MappingNode) and any(
        key.value == "image" for key, _ in root.value if isinstance(key, yaml.ScalarNode)
    )


class NodeReader:
    """Reads values from the nodes of one file."""

    failure: type[ValueError] = WorldFileError
    """What is raised; the message names the file and the line."""
    hint = f"a world is read from {KINDS}"
    """What the file should be, for a file that is something else."""
    elsewhere: Mapping[str, str] = MappingProxyType({})
    """Keys that other tools have for the keys."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> yaml.Node | None:
        """Read the file as nodes, which have line numbers and never run code."""
        try:
            content = read_file(self.path, _LARGEST_FILE)
        except OSError as error:
            raise self.failure(f"{self.path}: cannot be read: {error}") from error
        return self.parse(content)

    def parse(self, content: bytes) -> yaml.Node | None:
        """Turn the content of a file into nodes; a map is read as tolerantly as by yaml-cpp."""
        if len(content) > _LARGEST_FILE:  # A file to be written has not been checked.
            raise self.failure(f"{self.path}: has more than {_LARGEST_FILE} bytes")
        try:
            text = _decoded(content)
            if _IMAGE.search(text):
                spaced = text.replace("\t", " ")
                return next(yaml.compose_all(spaced, Loader=yaml.SafeLoader), None)
            return yaml.compose(content.decode(), Loader=yaml.SafeLoader)
        except UnicodeDecodeError as error:
            raise self.failure(f"{self.path}: is not UTF-8: {error}; {self.hint}") from error
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            where = f"{self.path}:{mark.line + 1}" if mark else str(self.path)
            problem = getattr(error, "problem", None) or cause_of(error)
            raise self.failure(f"{where}: is not YAML: {problem}") from error
        except RecursionError:
            raise self.failure(f"{self.path}: is nested too deeply") from None

    def error(self, node: yaml.Node | None, text: str) -> ValueError:
        """An error at the line of a node."""
        line = node.start_mark.line + 1 if node else 1
        return self.failure(f"{self.path}:{line}: {text}")

    def mapping(
        self, node: yaml.Node | None, what: str, keys: tuple[str, ...]
    ) -> dict[str, yaml.Node]:
        """Read a mapping that has no key twice, and as :meth:`unknown` says no others."""
        if not isinstance(node, yaml.MappingNode):
            hint = f"; {self.hint}" if what == "the file" else ""
            text = f"{what} must be a mapping with the keys {', '.join(keys)}{hint}"
            raise self.error(node, text)
        entries: dict[str, yaml.Node] = {}
        for key, value in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else None
            if name is None or name not in keys:
                hint = did_you_mean(self.elsewhere.get(name or "", name), keys)
                self.unknown(self.error(key, f"unknown key {name!r} in {what}"), hint, keys)
                continue
            if name in entries:
                raise self.error(key, f"key {name!r} appears twice in {what}")
            entries[name] = value
        return entries

    def unknown(self, error: ValueError, hint: str, keys: tuple[str, ...]) -> None:
        """Reject an unknown key; the hint is the nearest known one, if any is near."""
        raise self.failure(f"{error}; {hint or 'known are ' + ', '.join(keys)}")

    def items(self, node: yaml.Node, what: str) -> list[yaml.Node]:
        """Read a list."""
        if not isinstance(node, yaml.SequenceNode):
            raise self.error(node, f"{what} must be a list")
        if len(node.value) > _MOST_ENTRIES:
            count = len(node.value)
            raise self.error(node, f"{what} must have at most {_MOST_ENTRIES} entries, got {count}")
        return list(node.value)

    def number(self, node: yaml.Node, what: str, unit: str = " in meters") -> float:
        """Read a finite number; errors name the unit after "a number"."""
        value = read_number(node.value) if isinstance(node, yaml.ScalarNode) else math.nan
        if not math.isfinite(value):
            got = node.value if isinstance(node, yaml.ScalarNode) else "something else"
            raise self.error(node, f"{what} must be a number{unit}, got {got!r}")
        return value

    def text(self, node: yaml.Node, what: str) -> str:
        """Read text that is not empty."""
        if not isinstance(node, yaml.ScalarNode) or not node.value.strip():
            raise self.error(node, f"{what} must be text")
        return str(node.value)

    def pair(self, node: yaml.Node, what: str, form: str) -> tuple[float, float]:
        """Read a list of two numbers."""
        values = self.items(node, what)
        if len(values) != 2:
            raise self.error(node, f"{what} must be {form}, got {len(values)} entries")
        first, second = (self.number(value, what) for value in values)
        return first, second
