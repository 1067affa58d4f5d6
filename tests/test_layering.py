"""Who may import what, read from the source without running it."""

import ast
import sys
from functools import cache
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


@cache
def nodes_of(path):
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def imports(path):
    """Top-level names of all modules that a file imports, wherever in it."""
    found = set()
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)} has a relative import"
            found.add(node.module.split(".")[0])
    return found


def calls(path):
    """Names of all functions that a file calls directly."""
    calls = [node.func for node in nodes_of(path) if isinstance(node, ast.Call)]
    return {func.id for func in calls if isinstance(func, ast.Name)}


def importers(paths, names):
    """Those of some files that import one of some modules."""
    return {name_of(path) for path in paths if imports(path) & names}


def test_the_files_that_are_looked_at_are_there():
    assert len(REPLAY) >= 10
    assert len(TASKS) >= 5
    assert len(EVERYTHING) >= 200


def imported(node, alias):
    """Modules that one name of an import may stand for."""
    if isinstance(node, ast.Import):
        return (alias.name,)
    return f"{node.module}.{alias.name}", node.module


@cache
def arrows(package, *, types=False):
    """Which files of a package import which, by module; imports inside functions count too.

    Imports for the sake of types count if asked for, the package's own face, which imports all,
    does not.
    """
    root = {"mpfa_envs": ROOT / "envs", "training": ROOT / "examples"}.get(package, ROOT)
    folder = root / package
    files = {
        ".".join(path.relative_to(folder.parent).with_suffix("").parts).removesuffix(
            ".__init__"
        ): path
        for path in folder.rglob("*.py")
    }
    found = {}
    for module, path in files.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        typing = {
            id(each)
            for node in ast.walk(tree)
            if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
            for each in ast.walk(node)
            if not types
        }
        names = {
            name
            for node in ast.walk(tree)
            if isinstance(node, (ast.Import, ast.ImportFrom)) and id(node) not in typing
            for alias in node.names
            for name in imported(node, alias)
            if name in files
        }
        found[module] = names - {module, package}
    del found[package]
    return found


@pytest.mark.parametrize(
    ("package", "types"),
    [("torchrl_mpfa", True), ("mpfa_envs", True), ("training", False), ("benchmarks", True)],
)
def test_no_files_import_each_other_in_a_circle(package, types):
    left = {module: set(names) for module, names in arrows(package, types=types).items()}
    while ends := [module for module, names in left.items() if not names & set(left)]:
        for module in ends:
            del left[module]
    assert not left, f"these import each other in a circle, or what does: {sorted(left)}"


ROOMS = (
    {"checks", "files", "compiled", "saved", "tables"},
    {"worlds"},
    {"paths", "robots"},
    {"generators", "sensing"},
    {"safety"},
    {"driver"},
    {"control"},
    {"walkers", "tasks", "scene", "deploy"},
    {"env"},
    {"policies", "planners"},
    {"ros", "evaluation"},
    {"render"},
)
"""The rooms of the navigation task, from the ground up."""


def test_a_room_of_the_navigation_task_imports_those_below_it_alone():
    floor = {room: number for number, rooms in enumerate(ROOMS) for room in rooms}
    wrong = [
        f"{module} imports {name}"
        for module, names in arrows("mpfa_envs").items()
        for name in names
        if (ours := module.split(".")[1]) != (theirs := name.split(".")[1])
        and floor[theirs] >= floor[ours]
    ]
    assert not wrong


def test_the_replay_parts_import_torch_and_torchrl_and_little_else():
    allowed = {"torch", "tensordict", "torchrl", "numpy", "torchrl_mpfa", *sys.stdlib_module_names}
    found = {name_of(path): imports(path) - allowed for path in REPLAY}
    assert {name: more for name, more in found.items() if more} == {}


MESSAGES = {
    "diagnostic_msgs",
    "geometry_msgs",
    "nav2_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "rosgraph_msgs",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "tf2_ros",
}


@pytest.mark.parametrize(
    ("packages", "files"),
    [
        (
            {"pybullet", "pybullet_utils"},
            {"benchmarks/speed/bullet_world.py", "envs/mpfa_envs/robots/simulation.py"},
        ),
        ({"wandb"}, {"examples/training/run/loggers.py"}),
        ({"optuna"}, {"examples/tune.py"}),
        (
            {"rclpy", *MESSAGES},
            {
                "envs/mpfa_envs/ros/declared.py",
                "envs/mpfa_envs/ros/navigate_action.py",
                "envs/mpfa_envs/ros/policy_node.py",
                "envs/mpfa_envs/ros/robot_node.py",
                "envs/mpfa_envs/ros/status.py",
            },
        ),
    ],
)
def test_an_optional_package_is_imported_by_few_files(packages, files):
    users = importers(EVERYTHING, packages)
    assert {user for user in users if not user.startswith("tests/")} == files


PAGES = [*(ROOT / "examples").glob("*.py")]


@pytest.mark.parametrize(
    ("modules", "folders"),
    [
        ({"torchrl_mpfa"}, {"torchrl_mpfa", "examples", "benchmarks", "tests"}),
        ({path.stem for path in PAGES if path.stem != "gymnasium_td3"}, {"tests"}),
        # The runs of benchmarks/goals are those of the page.
        ({"gymnasium_td3"}, {"benchmarks", "tests"}),
        ({"benchmarks"}, {"benchmarks", "tests"}),
        # The source root of the navigation task is no package.
        ({"envs"}, set()),
    ],
)
def test_parts_are_imported_by_those_that_come_after_them(modules, folders):
    assert {user.split("/")[0] for user in importers(EVERYTHING, modules)} == folders


def test_the_training_application_s_folders_import_those_that_come_before_them():
    folder = ROOT / "examples/training"
    allowed = {
        "settings": set(),
        "run": {"settings"},
        "comparison": {"settings"},
        "": {"settings"},
    }
    for path in folder.rglob("*.py"):
        place = "" if path.parent == folder else path.parent.name
        modules = {node.module or "" for node in nodes_of(path) if isinstance(node, ast.ImportFrom)}
        found = {name.split(".")[1] for name in modules if name.startswith("training.")}
        assert found & set(allowed) <= allowed[place] | {place}, name_of(path)


def test_no_file_puts_folders_on_the_path():
    # Packages are found because they are installed; a script finds what lies beside it.
    found = [path for path in EVERYTHING if "sys.path" in path.read_text(encoding="utf-8")]
    assert found == [Path(__file__)]


def test_no_package_file_prints_or_exits():
    forbidden = {"print", "exit", "quit", "breakpoint"}
    assert not [name_of(path) for path in REPLAY + TASKS if calls(path) & forbidden]


def test_no_package_file_asserts_what_a_user_gives():
    assert not [
        f"{name_of(path)}:{node.lineno}"
        for path in REPLAY + TASKS
        for node in nodes_of(path)
        if isinstance(node, ast.Assert)
    ]


def test_no_file_is_named_after_nothing():
    nothing = {"utils", "util", "common", "helpers", "helper", "misc"}
    assert not [name_of(path) for path in EVERYTHING if path.stem in nothing]
