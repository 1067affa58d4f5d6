"""What a run of the tests leaves on the screen."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

IMPORTS_TRITON = """
import pytest
import triton


@pytest.fixture
def one_thread(): ...


@pytest.fixture
def fixed_seed(): ...


def test_nothing(): ...
"""


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["0", "1"])
def test_the_summary_is_the_last_line(tmp_path: Path, workers: str) -> None:
    pytest.importorskip("triton", reason="PyTorch brings it on Linux alone")
    shutil.copy(Path(__file__).with_name("conftest.py"), tmp_path)
    (tmp_path / "test_triton.py").write_text(IMPORTS_TRITON, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", workers, "."],
        cwd=tmp_path,
        # These tests may themselves run in a worker.
        env={k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.stdout.splitlines()[-1].startswith("1 passed in "), done.stdout
    assert "leaked" not in done.stdout  # Workers may end before the summary.
