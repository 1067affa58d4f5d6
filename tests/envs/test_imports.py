"""Modules that an import brings with it, each in a new process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import mpfa_envs

HEAVY = ("numba", "pybullet", "scipy", "torch", "torchrl", "yaml")


def run(code: str) -> str:
    """Output of code in a new process, where any warning is an error."""
    path = {"PYTHONPATH": str(Path(mpfa_envs.__file__).parents[1])}
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, check=True, capture_output=True, text=True, env=path).stdout


def test_the_package_alone_imports_nothing_heavy() -> None:
    assert run(f"import sys, mpfa_envs; print(*{{*{HEAVY}}} & set(sys.modules))").strip() == ""


@pytest.mark.parametrize("order", ["mpfa_envs, gymnasium", "gymnasium, mpfa_envs"])
def test_gymnasium_knows_the_ids_whichever_is_imported_first(order: str) -> None:
    code = f"import {order}; print(gymnasium.spec('mpfa/Navigation-D-v1').kwargs)"
    assert run(code).strip() == "{'world': 'D'}"


def test_without_gymnasium_the_package_can_still_be_imported() -> None:
    code = "import sys; sys.modules['gymnasium'] = None; import mpfa_envs; print(mpfa_envs.Box)"
    assert run(code).strip() == "<class 'mpfa_envs.worlds.shapes.Box'>"
