"""Wrong command lines of the study: one sentence that says the way out, and exit status 2."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.study import cliffwalk, paper_report, report, run, sampling
from benchmarks.study.gym import script as gym

ROOT = Path(__file__).parents[3]
A_FILE = r"file cannot be a folder, as .*file is a file: name another one"


@pytest.mark.parametrize(
    ("main", "line", "message"),
    [
        (run.main, "Z", "there is no table Z"),
        (run.main, "C --folder file", A_FILE),
        (run.main, "C --keep file", A_FILE),
        (report.main, "folder --output file", A_FILE),
        (report.main, "a b", "unrecognized arguments: b"),
        (paper_report.main, "folder --output file", A_FILE),
        (paper_report.main, "folder --seeds 0", "--seeds must be at least 1, got 0"),
        (gym.main, "--actions 400", "actions must be at least .*, 1000, got 400"),
        (cliffwalk.main, "--lengths 1", "--lengths"),
        (cliffwalk.main, "--eps inf", "--eps must be positive and finite, got inf"),
        (cliffwalk.main, "--output file", f"--output: {A_FILE}"),
        (sampling.main, "pr", "did you mean 'per'"),
        (sampling.main, "per --output file", f"--output: {A_FILE}"),
    ],
)
def test_a_wrong_command_line_is_one_sentence_and_status_2(
    main: Callable[[list[str]], int],
    line: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("x")
    with pytest.raises(SystemExit) as error:
        main(line.split())
    assert error.value.code == 2
    # The usage is before it.
    said = capsys.readouterr().err.splitlines()[-1]
    assert re.search(message, said), said
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("hidden", "words", "status", "said"),
    [
        ("sys.modules['hydra'] = sys.modules['pandas'] = None; ", "run", 1, "needs hydra, pandas"),
        ("", "rum", 2, "argument COMMAND: invalid choice: 'rum'"),
    ],
)
def test_a_missing_extra_or_a_wrong_command_is_one_sentence(
    hidden: str, words: str, status: int, said: str
) -> None:
    code = f"import runpy, sys; {hidden}runpy.run_module('benchmarks.study', run_name='__main__')"
    asked = [sys.executable, "-c", code, words]
    done = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == status
    assert said in done.stderr.splitlines()[-1]
