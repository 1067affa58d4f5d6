"""Who may import what, read from the source without running it."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
REPLAY = sorted((ROOT / "torchrl_mpfa").rglob("*.py"))
TASKS = sorted((ROOT / "envs/mpfa_envs").rglob("*.py"))
EVERYTHING = sorted(
    path
    for folder in ("torchrl_mpfa", "envs", "examples", "tests", "benchmarks")
    for path in (ROOT / folder).rglob("*.py")
)


def name_of(path):
    return path.relative_to(ROOT).as_posix()


def imports(path):
    """Top-level names of all modules that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)} has a relative import"
            found.add(node.module.split(".")[0])
    return found


def calls(path):
    """Names of all functions that a file calls directly."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return {func.id for func in calls if isinstance(func, ast.Name)}


def test_the_files_that_are_looked_at_are_there():
    assert len(REPLAY) >= 10
    assert len(TASKS) >= 5


@pytest.mark.parametrize("path", REPLAY, ids=name_of)
def test_the_replay_parts_import_torch_and_torchrl_and_little_else(path):
    allowed = {"torch", "tensordict", "torchrl", "numpy", "torchrl_mpfa"}
    assert imports(path) - set(sys.stdlib_module_names) <= allowed


@pytest.mark.parametrize("path", TASKS, ids=name_of)
def test_the_navigation_task_does_not_know_the_replay_parts(path):
    assert "torchrl_mpfa" not in imports(path)


def test_only_the_simulation_imports_pybullet():
    users = {name_of(path) for path in EVERYTHING if imports(path) & {"pybullet", "pybullet_utils"}}
    assert {user for user in users if not user.startswith("tests/")} == {
        "envs/mpfa_envs/simulation.py"
    }


def test_only_the_tracking_of_the_training_application_imports_wandb():
    users = {name_of(path) for path in EVERYTHING if "wandb" in imports(path)}
    assert {user for user in users if not user.startswith("tests/")} == {
        "examples/navigation/tracking.py"
    }


@pytest.mark.parametrize("path", EVERYTHING, ids=name_of)
def test_no_file_puts_folders_on_the_path(path):
    # Packages are found because they are installed; a script finds what lies beside it.
    assert "sys.path" not in path.read_text(encoding="utf-8") or path == Path(__file__)


@pytest.mark.parametrize("path", REPLAY + TASKS, ids=name_of)
def test_no_package_file_prints_or_exits(path):
    assert not calls(path) & {"print", "exit", "quit", "breakpoint"}


@pytest.mark.parametrize("path", REPLAY + TASKS, ids=name_of)
def test_no_package_file_asserts_what_a_user_gives(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert not [node.lineno for node in ast.walk(tree) if isinstance(node, ast.Assert)]


@pytest.mark.parametrize("path", EVERYTHING, ids=name_of)
def test_no_file_is_named_after_nothing(path):
    assert path.stem not in {"utils", "util", "common", "helpers", "helper", "misc"}


@pytest.mark.parametrize("path", EVERYTHING, ids=name_of)
def test_the_source_root_of_the_tasks_is_not_imported_as_a_package(path):
    assert "envs" not in imports(path)
