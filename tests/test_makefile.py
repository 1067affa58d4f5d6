"""The Makefile, run in a copy with interpreters that only pretend: nothing is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MAKE = shutil.which("make")
pytestmark = pytest.mark.skipif(MAKE is None, reason="make is not installed")

# Answers as Python does to what the Makefile asks of it, and writes down what pip is told.
PRETENDER = """#!/bin/sh
case "$*" in
  *base_prefix*version_info*) echo /somewhere 3.11 ;;
  *base_prefix*) echo /somewhere ;;
  "-m venv"*) mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
  "-m pip install"*) echo "$*" >> pip.log; [ ! -e no_network ] ;;
esac
"""
SHIM_THAT_FAILS = "#!/bin/sh\necho 'pyenv: python: command not found' >&2\nexit 127\n"
TOO_OLD = "#!/bin/sh\nexit 1\n"
LATER = PRETENDER.replace("esac", '  *"(3, 11)"*) exit 1 ;;\nesac')


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    folder = tmp_path / "copy"
    (folder / "bin").mkdir(parents=True)
    for name in ("Makefile", "pyproject.toml"):
        shutil.copy(ROOT / name, folder)
    for tool in ("sh", "rm", "mkdir", "cp", "touch", "sed", "cat"):
        found = shutil.which(tool)
        assert found is not None
        (folder / "bin" / tool).symlink_to(found)
    return folder


@pytest.fixture
def installed(copy: Path) -> Path:
    add_program(copy / ".venv" / "bin" / "python", PRETENDER)
    for stamp in STAMPS:
        (copy / ".venv" / stamp).touch()
    return copy


def add_program(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    path.chmod(0o755)


def make(
    folder: Path, *arguments: str, stdout: int = subprocess.PIPE
) -> subprocess.CompletedProcess[str]:
    # These tests may themselves run under make, which hands its flags on.
    dropped = ("MAKEFLAGS", "MAKELEVEL", "MFLAGS", "PYTHON", "ARGS", "SLOW", "EPISODES")
    environment = {k: v for k, v in os.environ.items() if k not in dropped}
    environment["PATH"] = str(folder / "bin")
    assert MAKE is not None
    return subprocess.run(
        [MAKE, *arguments],
        cwd=folder,
        env=environment,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )


NEW_PIP = "-m pip install -q pip>=23.1"
STAMPS = (".installed", ".installed-dev")
SCRIPTS, REST = (f"-m pip install -q -e .[{extra}]" for extra in ("examples", "dev"))


def pip_calls(folder: Path) -> list[str]:
    """What was installed beside pip itself."""
    log = folder / "pip.log"
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    return [line for line in lines if line != NEW_PIP]


def test_make_alone_lists_the_targets(copy: Path) -> None:
    done = make(copy)
    assert done.returncode == 0
    targets = [line.split()[0] for line in done.stdout.splitlines() if line.startswith("  ")]
    assert targets == [
        "help", "demo", "train", "paper", "test", "check", "format", "docs", "bench", "wheel-test",
        "clean",
    ]  # fmt: skip
    assert not (copy / ".venv").exists()


@pytest.mark.parametrize(
    ("arguments", "commands"),
    [
        (
            ["demo"],
            [
                "python examples/train.py run_dir=runs/demo overwrite=true",
                "tracking=off actions=30000",
                "python examples/evaluate.py runs/demo --worlds all --episodes 20",
                "cd runs/demo/evaluation-all-",
                "cp evaluation.json trajectories.png episode.gif ..",
            ],
        ),
        (
            ["demo", "EPISODES=2", "DEMO_ACTIONS=900"],
            ["actions=900", "--worlds all --episodes 2"],
        ),
        (
            ["train", "ARGS=method=per seed=1"],
            ["python examples/train.py regime=rooms", "method=per seed=1"],
        ),
        (["test"], ["python -m pytest"]),
        (["test", "WORKERS=0", "SLOW=1"], ["python -m pytest -n 0", "-m 'slow or not slow'"]),
        (
            ["check"],
            ["ruff format --check .", "ruff check .", "mypy", "--doctest-modules torchrl_mpfa"],
        ),
        (["doctest"], ["python -m pytest --doctest-modules torchrl_mpfa envs"]),
        (["bench", "ARGS=--quick"], ["python -m benchmarks.speed --quick"]),
        (["wheel-test"], ["python .ci/wheel_test.py"]),
    ],
)
def test_each_target_runs_its_commands_and_installs_nothing_twice(
    installed: Path, arguments: list[str], commands: list[str]
) -> None:
    done = make(installed, "-n", *arguments)
    assert done.returncode == 0, done.stderr
    assert "pip install" not in done.stdout
    places = [done.stdout.find(command) for command in commands]
    assert -1 not in places, done.stdout
    assert places == sorted(places)


@pytest.mark.parametrize("goals", [["check"], ["check", "test"], ["test", "check"]], ids=" ".join)
def test_tests_and_doctests_run_once_when_checks_are_asked_for(
    installed: Path, goals: list[str]
) -> None:
    lines = make(installed, "-n", *goals).stdout.splitlines()
    (tests,) = [line for line in lines if "-m pytest" in line]
    both = "-n 2 --dist worksteal --doctest-modules torchrl_mpfa envs tests"
    assert tests.split(" -m pytest ")[1].split() == both.split()


@pytest.mark.parametrize(
    ("programs", "words", "chosen", "said"),
    [
        # A shim that fails is passed over, and a later Python taken if there is no other.
        ({"python3.11": SHIM_THAT_FAILS, "python3": PRETENDER}, ["bench"], "python3", ""),
        ({"python3": LATER, "python": PRETENDER}, ["test"], "python", ""),
        ({"python3": LATER}, ["test"], "python3",
         "python3 is later than Python 3.11, so that there is no PyBullet"),
        ({"python3": LATER}, ["PYTHON=python3", "test"], "python3", "no PyBullet"),
        *(
            ({"python3.11": PRETENDER, "given": given}, ["PYTHON=given", "demo"], None,
             "PYTHON=given is not a Python 3.10 or later")
            for given in (SHIM_THAT_FAILS, TOO_OLD)
        ),
        ({"python3.11": SHIM_THAT_FAILS, "python3": TOO_OLD}, ["test"], None,
         "no Python 3.10 or later found"),
    ],
)  # fmt: skip
def test_a_python_that_fits_is_chosen_or_one_line_says_the_way_out(
    copy: Path, programs: dict[str, str], words: list[str], chosen: str | None, said: str
) -> None:
    for name, program in programs.items():
        add_program(copy / "bin" / name, program)
    done = make(copy, *words)
    line, *rest = done.stderr.splitlines() or [""]
    assert said in line
    if chosen:
        assert done.returncode == 0, done.stderr
        assert f"making .venv with {chosen}\n" in done.stdout
        assert bool(line) == bool(said) and not rest
    else:
        assert done.returncode != 0
        assert f"make PYTHON=/path/to/python3.11 {words[-1]}" in line
        assert all("Error" in other for other in rest), done.stderr  # That make stops, no more.
        assert pip_calls(copy) == []


def test_the_install_happens_once_and_again_when_the_project_file_changed(copy: Path) -> None:
    add_program(copy / "bin" / "python3.11", PRETENDER)
    assert make(copy, "-q", ".venv/.installed").returncode == 1
    assert make(copy, "test").returncode == 0
    assert (copy / "pip.log").read_text().splitlines() == [NEW_PIP, SCRIPTS, REST]
    assert make(copy, "test").returncode == 0
    for stamp in STAMPS:
        assert make(copy, "-q", f".venv/{stamp}").returncode == 0
    assert len(pip_calls(copy)) == 2

    changed = (copy / ".venv" / ".installed-dev").stat().st_mtime + 10
    os.utime(copy / "pyproject.toml", (changed, changed))
    done = make(copy, "test")
    assert done.returncode == 0
    assert len(pip_calls(copy)) == 4
    assert "making .venv" not in done.stdout  # The environment itself is kept.


def test_pip_shows_its_progress_where_someone_looks(copy: Path) -> None:
    add_program(copy / "bin" / "python3.11", PRETENDER)
    screen, end = os.openpty()
    assert make(copy, ".venv/.installed-dev", stdout=end).returncode == 0
    for opened in (screen, end):
        os.close(opened)
    assert [line.replace(" -q", "") for line in (NEW_PIP, SCRIPTS, REST)] == [
        *(copy / "pip.log").read_text().splitlines()
    ]


def test_another_python_of_the_same_prefix_has_an_environment_of_its_own(copy: Path) -> None:
    add_program(copy / "bin" / "python3.11", PRETENDER)
    other = LATER.replace("/somewhere 3.11", "/somewhere 3.12")
    add_program(copy / "bin" / "python3.12", other)
    for program, calls, again in (
        ("python3.12", 2, True),
        ("python3.12", 2, False),
        ("python3.11", 4, True),
        ("python3.11", 4, False),
    ):
        done = make(copy, f"PYTHON={program}", "test")
        assert done.returncode == 0, done.stderr
        assert len(pip_calls(copy)) == calls
        assert (f"making .venv with {program}\n" in done.stdout) == again
    rejected = make(copy, "PYTHON=/nonexistent", "test")
    assert rejected.returncode != 0
    assert "PYTHON=/nonexistent is not a Python" in rejected.stderr


def test_an_install_that_failed_is_made_again(copy: Path) -> None:
    add_program(copy / "bin" / "python3.11", PRETENDER)
    (copy / "no_network").touch()
    assert make(copy, "test").returncode != 0
    assert not (copy / ".venv" / ".installed").exists()
    (copy / "no_network").unlink()
    assert make(copy, "test").returncode == 0
    assert pip_calls(copy) == [SCRIPTS, REST]


def test_other_arguments_for_torch_install_again_and_the_same_or_none_do_not(copy: Path) -> None:
    add_program(copy / "bin" / "python3.11", PRETENDER)
    other = "torch==2.15.* --index-url 'file:///a b'"
    for words, calls in (
        ([], 2),
        (["TORCH_INSTALL_ARGS=./torch-cpu.whl"], 5),
        (["TORCH_INSTALL_ARGS=./torch-cpu.whl"], 5),
        ([], 5),
        ([f"TORCH_INSTALL_ARGS={other}"], 8),
        ([f"TORCH_INSTALL_ARGS={other}"], 8),
    ):
        done = make(copy, "test", *words)
        assert done.returncode == 0, done.stderr
        assert len(pip_calls(copy)) == calls
    assert pip_calls(copy)[5] == "-m pip install -q torch==2.15.* --index-url file:///a b"
