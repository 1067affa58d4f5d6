"""The page on a robot of one's own, from its numbers to an order of a pilot, as it is printed."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from mpfa_envs import load_policy, load_robot
from mpfa_envs.robots.resolve import resolve_robot

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "howto" / "robot.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^```(yaml|python|bash)\n(.*?)^```", re.DOTALL | re.MULTILINE)
ENOUGH = 0.95
"""Share of the tasks in the plan that a robot is to reach the goal of."""


def success(folder: Path) -> float:
    """Share of the goals that an evaluation reached."""
    document = json.loads((folder / "evaluation.json").read_text(encoding="utf-8"))
    return float(document["success"])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_page_leads_to_a_robot_that_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnx", reason="exported policies are of the extra onnx")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    names: dict[str, Any] = {}
    for kind, text in BLOCK.findall(PAGE):
        if kind == "yaml":
            Path("cart.yaml").write_text(text, encoding="utf-8")
        elif kind == "python":
            exec(text, names)
        else:
            command = text.replace(".venv/bin/python", sys.executable)
            subprocess.run(
                ["bash", "-ec", command], check=True, env={**os.environ, "TQDM_DISABLE": "1"}
            )
    assert success(next(Path("runs/cart").glob("evaluation-plan*"))) >= ENOUGH
    assert resolve_robot(load_policy("runs/cart").env_arguments["robot"]) == load_robot("cart.yaml")
    assert names["command"].linear > 0.0
