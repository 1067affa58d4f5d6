"""Errors where an extra of the package is not installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

POLICY = Path(__file__).parents[2] / "examples" / "policies" / "td3-mpfa_per.npz"


@pytest.mark.parametrize(
    ("without", "code", "message"),
    [
        (
            "gymnasium",
            "from mpfa_envs import make_navigation_env",
            "mpfa_envs.make_navigation_env needs gymnasium: pip install 'torchrl-mpfa[envs]'",
        ),
        (
            "onnxruntime",
            "from mpfa_envs.deploy import Network; Network(b'', 1, 1)",
            "an exported policy needs onnxruntime",
        ),
        (
            "onnx",
            f"from mpfa_envs import *;export_policy(load_policy({str(POLICY)!r}), 'policy.onnx')",
            "pip install 'torchrl-mpfa[onnx]'",
        ),
    ],
)
def test_the_error_of_a_missing_package_names_its_extra(
    without: str, code: str, message: str, tmp_path: Path
) -> None:
    hidden = f"import sys; sys.modules[{without!r}] = None; {code}"
    done = subprocess.run(
        [sys.executable, "-c", hidden], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode != 0
    assert message in done.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())
