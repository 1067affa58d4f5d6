"""What an import brings with it, each in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import mpfa_envs

HEAVY = ("gymnasium", "numba", "pybullet", "scipy", "torch", "torchrl", "yaml")


def run(code: str) -> str:
    """What some code prints in a fresh process, where any warning is an error."""
    path = {"PYTHONPATH": str(Path(mpfa_envs.__file__).parents[1])}
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, check=True, capture_output=True, text=True, env=path).stdout


def test_the_package_alone_brings_nothing() -> None:
    assert run(f"import sys, mpfa_envs; print(*{{*{HEAVY}}} & set(sys.modules))").strip() == ""


@pytest.mark.parametrize("order", ["mpfa_envs, gymnasium", "gymnasium, mpfa_envs"])
def test_gymnasium_knows_the_ids_whichever_is_imported_first(order: str) -> None:
    code = f"import {order}; print(gymnasium.spec('mpfa/Navigation-D-v1').kwargs)"
    assert run(code).strip() == "{'world': 'D'}"


def test_asking_for_gymnasium_before_its_import_keeps_the_ids() -> None:
    asked = "import importlib.util, mpfa_envs; importlib.util.find_spec('gymnasium'); "
    code = f"{asked}import gymnasium; print(gymnasium.spec('mpfa/Rooms-v1').id)"
    assert run(code).strip() == "mpfa/Rooms-v1"
