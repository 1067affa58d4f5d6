"""Wrong command lines of the study: one sentence that says the way out, and exit status 2."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.study import cliffwalk, paper_report, pictures, report, run, sampling
from benchmarks.study.gym import script as gym

ROOT = Path(__file__).parents[3]
A_FILE = r"file cannot be a folder, as .*file is a file: name another one"
GYM = "--tasks Pendulum-v1"


@pytest.mark.parametrize(
    ("main", "line", "message"),
    [
        (run.main, "Z", "there is no table Z; there are: C, D, A, B"),
        (run.main, "--seeds 0", "--seeds must be at least 1, got 0"),
        (run.main, "--jobs 0", "--jobs must be at least 1, got 0"),
        (run.main, "--kept new", "new: no rows of the study are there, which --keep writes"),
        (run.main, "C --folder file", A_FILE),
        (run.main, "C --keep file", A_FILE),
        (report.main, "folder --output file", A_FILE),
        (report.main, "a b", "unrecognized arguments: b"),
        (paper_report.main, "folder --output file", A_FILE),
        (paper_report.main, "folder --seeds 0", "--seeds must be at least 1, got 0"),
        (gym.main, "--tasks Pendulum-v0", r"'Pendulum-v0': did you mean 'Pendulum-v1'\?"),
        (gym.main, f"{GYM} --methods perr", r"unknown method 'perr': did you mean 'per'\?"),
        (gym.main, f"{GYM} --seeds -1", "seed must be from 0 to 9999, got -1"),
        (gym.main, f"{GYM} --seeds 1 1", "--seeds has 1 twice"),
        (gym.main, f"{GYM} --jobs 0", "--jobs must be at least 1, got 0"),
        (gym.main, f"{GYM} --actions 0", "actions must be an integer from 1 to 2147483647, got 0"),
        (gym.main, f"{GYM} --actions 10", "actions must be a multiple of 4, got 10"),
        (gym.main, "--actions 400", "actions must be at least .*, 1000, got 400"),
        (cliffwalk.main, "--lengths 1", "--lengths: .*length"),
        (cliffwalk.main, "--lengths a", "--lengths"),
        (cliffwalk.main, "--seeds 0", "--seeds must be at least 1, got 0"),
        (cliffwalk.main, "--eps -1", "--eps must be positive and finite, got -1"),
        (cliffwalk.main, "--eps inf", "--eps must be positive and finite, got inf"),
        (cliffwalk.main, "--output file", f"--output: {A_FILE}"),
        (pictures.main, "values --output new", "values needs --run, the folder of a run"),
        (sampling.main, "pr", r"unknown method 'pr': did you mean 'per'\?"),
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
