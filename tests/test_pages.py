"""Pages whose files and commands are run as they stand there, only shorter."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = ["howto/signal.md", "howto/task.md", "howto/torchrl_script.md", "howto/train.md"]
FILE = re.compile(r"^```python\n# (\w+\.py)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
COMMAND = re.compile(r"^    (?:\.venv/bin/)?(python [^#\n]*)", re.MULTILINE)
SHORT = (
    (r"\bactions=(\d+)000", lambda found: f"actions={50 * int(found[1])} evaluation.every=500"),
    (r"--trials \d+", "--trials 1"),
    (r"(sb3_replay.* --actions) \d+", r"\1 300"),
    (r"0 1 2", "0 1"),
)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_the_files_and_commands_of_a_page_work_in_their_order(page: str, tmp_path: Path) -> None:
    text = (DOCS / page).read_text(encoding="utf-8")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    for name, code in FILE.findall(text):
        (tmp_path / name).write_text(code, encoding="utf-8")
    commands = COMMAND.findall(text)
    assert commands
    path = os.pathsep.join(str(ROOT / each) for each in ("", "envs", "examples"))
    for command in commands:
        for long, short in SHORT:
            command = re.sub(long, short, command)
        words = [sys.executable, *shlex.split(command)[1:]]
        done = subprocess.run(
            words,
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": path, "WANDB_MODE": "offline", "TQDM_DISABLE": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
