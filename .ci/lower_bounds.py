"""Print constraints that pin every dependency at its lower bound, for ``pip install -c``.

    python .ci/lower_bounds.py > lower.txt
    python -m venv oldest && oldest/bin/pip install -c lower.txt '.[dev]'
    oldest/bin/python -m pytest

Needs Python 3.11 or later, whose standard library reads pyproject.toml.
"""

from __future__ import annotations

import re
from pathlib import Path

import tomllib

PROJECT = Path(__file__).resolve().parent.parent / "pyproject.toml"
_LOWER = re.compile(r"(?P<name>[\w.-]+)(\[.*?\])?>=(?P<version>[\d.]+)")


def constraints(project: Path = PROJECT) -> list[str]:
    """One line for each dependency of the project and its extras.

    Args:
        project: Its ``pyproject.toml``.

    Returns:
        Lines such as ``numpy==2.0.*``: of a version of fewer than three parts any patch will do.
    """
    about = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    listed = [about["dependencies"], *about["optional-dependencies"].values()]
    lines = set()
    for found in (_LOWER.match(text) for texts in listed for text in texts):
        if found:  # An extra that asks for another extra has no version.
            parts = found["version"].split(".")
            version = found["version"] if len(parts) > 2 else f"{parts[0]}.{[*parts, '0'][1]}.*"
            lines.add(f"{found['name']}=={version}")
    return sorted(lines, key=str.lower)


if __name__ == "__main__":
    print("\n".join(constraints()))
