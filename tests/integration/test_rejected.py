"""Wrong command lines: one sentence that says the way out, and exit status 2."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import compare
import evaluate
import export
import play
import report
import train
import tune
from mpfa_envs.policies.policy import policy_file
from training import files

POLICY = "td3-paper"
A_FILE = r"file cannot be a folder, as .*file is a file: name another one"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the commands are run: files that are none of theirs, and damaged ones."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("x")
    (tmp_path / "damaged.npz").write_bytes(b"PK\x03\x04 and no more")
    flipped = bytearray(policy_file(POLICY).read_bytes())
    flipped[len(flipped) // 2] ^= 1
    (tmp_path / "flipped.npz").write_bytes(flipped)
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "damaged.yaml").write_text("room: [1, 2\n")
    for name, line in {
        "typo": "learner.tua: {low: 0.001, high: 0.01}",
        "over": "learner.gamma: {low: 0.9, high: 1.5}",
        "swapped": "learner.tau: {low: 0.1, high: 0.01}",
        "zero": "learner.tau: {low: 0, high: 0.01, log: true}",
        "whole": "updates: {low: 1.5, high: 4}",
        "lowest": "learner.tau: {lowest: 0.001, high: 0.01}",
        "choice": "method: [per, unifrom]",
        "judge": "evaluation.episodes: [10, 20]",
        "value": "learner.tau: 0.01",
        "list": "- learner.tau",
    }.items():
        (tmp_path / f"{name}.yaml").write_text(f"{line}\n")
    contents = {
        "rows": b"a,b\n1\n2,3,4\n",
        "bytes": bytes(range(128, 255)),
        "nothing": b"",
        "run": b"success,world\n1,A\n",
    }
    for name, content in contents.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "episodes.csv").write_bytes(content)
    run = tmp_path / "study" / "ddpg-per-0"
    run.mkdir(parents=True)
    (run / "settings.json").write_text("{")
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint/checkpoint.pt").write_bytes(b"123")
    return tmp_path


def status_of(main: Callable[..., object], arguments: list[str]) -> object:
    try:
        return main() if main is train.main else main(arguments)
    except SystemExit as error:
        return error.code


@pytest.mark.parametrize(
    ("main", "line", "message"),
    [
        (train.main, "--help foo=3", "^train.py: Could not override 'foo'"),
        (train.main, "resume=nowhere", "resume: there is no folder nowhere"),
        (train.main, "resume=rows", "there is no checkpoint.pt in rows"),
        (train.main, "resume=checkpoint", "checkpoint.pt is damaged or not a checkpoint"),
        (train.main, "run_dir=file", A_FILE),
        (train.main, "run_dir=", "run_dir must not be empty, got ''"),
        (train.main, "-m seed=0,1 run_dir=mine", "the folder hydra.sweep.dir=FOLDER"),
        (train.main, f"seed={2**62}", f"seed must be from 0 to 4294967295, got {2**62}"),
        (train.main, "tracking.group=", "tracking.group must be a word of at most 128 letters"),
        (train.main, "learner.width=3000000", "learner.width must be from 1 to 65536, got 3000000"),
        (train.main, "method.signals=[rewad]", "method.signals must be of .*, got 'rewad'"),
        (
            train.main,
            "curriculum.stages=[{world:damaged.yaml,episodes:1}]",
            r"curriculum.stages\[0\].world .*: damaged.yaml:2: is not YAML",
        ),
        (evaluate.main, "", "give either the path of a trained policy or --policy"),
        (evaluate.main, f"{POLICY} --policy dwa", "give either the path of a trained policy or"),
        (evaluate.main, "--policy astar --memory map", "--memory map is for --policy dwa alone"),
        (evaluate.main, "--policy dwb", "invalid choice: 'dwb'"),
        (evaluate.main, "damaged.npz", "damaged.npz"),
        (evaluate.main, f"{POLICY} --output file", A_FILE),
        (evaluate.main, f"{POLICY} --worlds damaged.yaml", "damaged.yaml:2: is not YAML"),
        (evaluate.main, f"{POLICY} --worlds rooms:5-2", "rooms:5-2 ends before it begins"),
        (evaluate.main, f"{POLICY} --worlds rooms:1-999999999", "at most 10000 worlds"),
        (evaluate.main, f"{POLICY} --worlds A A", "world 'A' is named twice"),
        (evaluate.main, f"{POLICY} --episodes 0", "--episodes must be at least 1, got 0"),
        (evaluate.main, f"{POLICY} --noise slop=1", "slop"),
        (compare.main, "--folder file", A_FILE),
        (compare.main, "--methods pr", "unknown method 'pr': did you mean 'per'"),
        (compare.main, "--methods per per", "--methods has per twice"),
        (compare.main, "--seeds 0 0", "--seeds has 0 twice"),
        (compare.main, "--arm a: --arm a:robots=2", "--arm has a twice"),
        (compare.main, "--arm robots=2", "--arm robots=2: must be NAME:SETTING=VALUE"),
        (compare.main, "--arm a/b:robots=2", "with a NAME of letters, digits"),
        (compare.main, "--arm a:robtos=2", r"unknown setting 'robtos': did you mean 'robots'\?"),
        (compare.main, "--arm a:method.alpha=1,2", "--arm a:method.alpha=1,2: '2' is not NAME="),
        (compare.main, "--arm a:seed=3", "seed is what the comparison gives each run"),
        (
            compare.main,
            "--folder study --methods uniform --seeds 0 -- learner.gamma=2",
            r"^compare.py: learner.gamma must be in \[0, 1\]",
        ),
        (
            compare.main,
            "--folder study --methods per --seeds 0",
            "settings.json is damaged: remove it, and the run is made again",
        ),
        (compare.main, "-- settings=typo.yaml", "typo.yaml: unknown setting 'learner.tua'"),
        (train.main, "settings=nowhere", "^train.py: there is no file nowhere$"),
        (train.main, "settings=list.yaml", "list.yaml must have a line NAME: VALUE for each"),
        (train.main, "settings=value.yaml settings=typo.yaml", "settings must be one file, got"),
        (
            train.main,
            "settings=typo.yaml",
            r"^train.py: typo.yaml: unknown setting 'learner.tua': did you mean 'learner.tau'\?$",
        ),
        (tune.main, "--ranges over.yaml", r"over.yaml: learner.gamma must be in \[0, 1\], got 1.5"),
        (tune.main, "--ranges swapped.yaml", "learner.tau: .*`low <= high` must hold"),
        (tune.main, "--ranges zero.yaml", r"learner.tau must be in \(0, 1\], got 0"),
        (tune.main, "--ranges whole.yaml", "updates: Value '1.5' of type 'float' could not be"),
        (tune.main, "--ranges lowest.yaml", "or {low: NUMBER, high: NUMBER}"),
        (tune.main, "--ranges choice.yaml", "'unifrom' of 'method': did you mean 'uniform'"),
        (tune.main, "--ranges judge.yaml", "evaluation.episodes cannot be searched"),
        (tune.main, "updates=4", "tune.yaml: updates is given to all trials"),
        (tune.main, "learner", "'learner' is not NAME=VALUE"),
        (tune.main, "seed=3", "seed is what the search gives each run"),
        (tune.main, "robots=8,16", "a search takes one value for each setting"),
        (
            tune.main,
            "evaluation.every=0 evaluation.choose=false",
            "evaluation.every must be from 1 to the 30000 actions",
        ),
        (
            tune.main,
            "evaluation.every=30001",
            "evaluation.every must be from 1 to the 30000 actions",
        ),
        (
            tune.main,
            "evaluation.world=test evaluation.choose=false",
            "evaluation.world must not be of a test, got test",
        ),
        (report.main, "nowhere", "there is no nowhere"),
        (report.main, "study", "study: neither episodes.csv of compare.py nor rows of task"),
        (report.main, "run study/../run", "is named twice: its runs count once"),
        (report.main, "rows", "episodes.csv is damaged, its rows cannot be read"),
        (report.main, "nothing", "episodes.csv is damaged, its rows cannot be read"),
        (report.main, "run", "has no column learner: name the folder of a comparison"),
        (report.main, "run --output file", A_FILE),
        (play.main, "nothing.npz", "there is no policy at nothing.npz"),
        (export.main, "damaged.npz", "damaged.npz"),
        (export.main, f"{POLICY} --output file/policy.onnx", f"--output: {A_FILE}"),
        (export.main, f"{POLICY} --output rows", "--output must end in .onnx, got rows"),
    ],
)
def test_a_wrong_command_line_is_one_sentence_and_status_2(
    main: Callable[..., object],
    line: str,
    message: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = sorted(folder.rglob("*"))
    monkeypatch.setattr(sys, "argv", [f"{main.__module__}.py", *line.split()])
    assert status_of(main, line.split()) == 2
    # The usage may be before it.
    said = capsys.readouterr().err.splitlines()[-1]
    assert re.search(message, said), said
    # Nothing was begun.
    made = [path for path in folder.rglob("*") if path not in before and path.name != ".lock"]
    assert not made


@pytest.mark.parametrize(
    ("main", "line"),
    [
        (train.main, "environment.physics=wheels run_dir=new"),
        (evaluate.main, POLICY),
        (compare.main, "--physics wheels"),
    ],
)
def test_without_pybullet_wheels_are_rejected_before_anything_has_begun(
    main: Callable[..., object],
    line: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)  # As where it is not installed.
    monkeypatch.delitem(sys.modules, "mpfa_envs.robots.simulation", raising=False)
    monkeypatch.setattr(sys, "argv", [f"{main.__module__}.py", *line.split()])
    before = sorted(folder.rglob("*"))
    assert status_of(main, line.split()) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "physics='wheels' needs PyBullet" in said, said
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("main", "line"),
    [
        (train.main, "run_dir=out"),
        (evaluate.main, f"{POLICY} --output out"),
        (compare.main, "--folder out"),
    ],
)
def test_a_folder_in_use_is_rejected(
    main: Callable[..., object],
    line: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", [f"{main.__module__}.py", *line.split()])
    with files.lock(folder / "out"):
        assert status_of(main, line.split()) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert re.match(rf"{main.__module__}.py: another process is using .*out", said), said
    assert [path.name for path in (folder / "out").iterdir()] == [".lock"]


@pytest.mark.parametrize("script", ["train", "evaluate", "compare", "report"])
def test_without_its_extra_a_script_says_so_in_one_sentence(script: str, tmp_path: Path) -> None:
    file = Path(train.__file__ or "").with_name(f"{script}.py")
    hidden = (
        "import runpy, sys; sys.modules['hydra'] = sys.modules['pandas'] = None; "
        f"runpy.run_path({str(file)!r}, run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", hidden], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    needed = "install the extra 'examples', see Install in the README"
    assert done.stderr == f"this script needs hydra, pandas: {needed}\n"
