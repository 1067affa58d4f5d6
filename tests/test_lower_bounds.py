"""The constraints to try the oldest dependencies with."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(
    sys.version_info < (3, 11), reason="the script reads TOML by Python 3.11's tomllib"
)
def test_each_dependency_is_pinned_once_at_its_lower_bound() -> None:
    lines = runpy.run_path(str(ROOT / ".ci" / "lower_bounds.py"))["constraints"]()
    names = [line.partition("==")[0] for line in lines]
    assert len(set(names)) == len(names)
    # Each requirement of the file is in quotation marks, and begins with its name.
    asked = re.findall(
        r'"([\w.-]+)(?:\[[\w,]+\])?>=[\d.]+', (ROOT / "pyproject.toml").read_text("utf-8")
    )
    assert set(names) == set(asked)
    assert "torch==2.14.*" in lines
    assert "torchrl==0.14.1" in lines
    assert "numpy==2.0.*" in lines
