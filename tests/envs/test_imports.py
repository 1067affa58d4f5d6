"""Imports in new processes: modules that they bring with them, and packages that are missing."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.envs.exported import SHIPPED
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


@pytest.mark.parametrize(
    ("without", "code", "message"),
    [
        (
            "gymnasium",
            "from mpfa_envs import NavigationEnv",
            "mpfa_envs.NavigationEnv needs gymnasium: install the extra 'envs', see Install in the "
            "README",
        ),
        (
            "onnxruntime",
            "from mpfa_envs.deploy import Network; Network(b'', 1, 1)",
            "an exported policy needs onnxruntime",
        ),
        (
            "onnx",
            "from mpfa_envs import export_policy, load_policy;"
            f"export_policy(load_policy({SHIPPED!r}), 'policy.onnx')",
            "install the extra 'onnx', see Install in the README",
        ),
    ],
)
def test_the_error_of_a_missing_package_names_its_extra(
    without: str, code: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(subprocess.CalledProcessError) as caught:
        run(code, without=[without])
    assert message in caught.value.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())
