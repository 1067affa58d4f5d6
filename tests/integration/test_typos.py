"""What is misspelt on a command line is answered with a hint, before PyTorch's libraries load."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
HEAVY = ("torchrl", "wandb", "matplotlib", "pandas")
"""Packages that together take longer to import than all else."""


@pytest.mark.parametrize(
    ("script", "word", "hint"),
    [
        ("train.py", "environment.robt=burger", "did you mean 'environment.robot'?"),
        ("train.py", "curriculum.stages=[{world:A,action:500}]", "did you mean 'actions'?"),
        ("evaluate.py", "td3-room", "there is no policy at td3-room"),
        ("report.py", "runs/nowhere", "there is no runs/nowhere"),
    ],
)
def test_a_typo_is_answered_before_the_parts_of_a_run_are_imported(
    script: str, word: str, hint: str
) -> None:
    path = str(EXAMPLES / script)
    code = (
        f"import runpy, sys, training.extra; sys.modules.update(dict.fromkeys({HEAVY})); "
        f"sys.argv = [{path!r}, {word!r}]; runpy.run_path({path!r}, run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2 and hint in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("script", ["train", "evaluate", "compare", "tune", "report"])
def test_a_script_imports_no_torchrl_before_it_reads_its_command_line(script: str) -> None:
    code = f"import sys, {script}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", *HEAVY} & set(done.stdout.split())
