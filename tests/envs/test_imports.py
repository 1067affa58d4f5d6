"""Modules that an import brings with it, each in a new process."""

from __future__ import annotations

import pytest

from tests.envs.process import run

HEAVY = ("numba", "pybullet", "scipy", "torch", "torchrl", "yaml")


def test_the_package_alone_imports_nothing_heavy() -> None:
    code = f"import mpfa_envs; print(*{{*{HEAVY}}} & set(sys.modules))"
    assert run(code, PYTHONWARNINGS="error") == "\n"


@pytest.mark.parametrize("order", ["mpfa_envs, gymnasium", "gymnasium, mpfa_envs"])
def test_gymnasium_knows_the_ids_whichever_is_imported_first(order: str) -> None:
    code = f"import {order}; print(gymnasium.spec('mpfa/Navigation-D-v1').kwargs)"
    assert run(code, PYTHONWARNINGS="error") == "{'world': 'D'}\n"


def test_without_gymnasium_the_package_can_still_be_imported() -> None:
    code = "import mpfa_envs; print(mpfa_envs.Box)"
    found = run(code, without=["gymnasium"], PYTHONWARNINGS="error")
    assert found == "<class 'mpfa_envs.worlds.shapes.Box'>\n"
