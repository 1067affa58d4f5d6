"""What the packages promise: names, their docstrings, modules after a bare import."""

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import torchrl_mpfa
from torchrl_mpfa import SignalSampler, SignalTensorStorage
from torchrl_mpfa.samplers import SignalTable
from torchrl_mpfa.samplers.trees import CompiledTrees

ROOT = Path(__file__).resolve().parents[1]
SAID = {
    "anneal",
    "stats",
    "clear",
    "blank",
    "replay_counts",
    "move_to",
    "take",
    "restored",
    "fill_learned",
}
"""Of users, and of a part to itself and its states."""
SAID |= {"state_dict"}
NAMES = [name for name in torchrl_mpfa.__all__ if name.upper() != name]


def test_the_list_of_public_names_is_sorted_complete_and_without_twins():
    names = torchrl_mpfa.__all__
    constants = [name for name in names if name.upper() == name]
    classes = [name for name in names if name[0].isupper() and name not in constants]
    functions = [name for name in names if name[0].islower()]
    assert names == sorted(constants) + sorted(classes) + sorted(functions)
    assert len(set(names)) == len(names)
    tree = ast.parse(Path(torchrl_mpfa.__file__).read_text(encoding="utf-8"))
    # What type checkers are told.
    typed = {
        alias.name
        for block in tree.body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert typed == set(names)
    assert all(hasattr(torchrl_mpfa, name) for name in names)


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_has_a_docstring(name):
    thing = getattr(torchrl_mpfa, name)
    doc = inspect.getdoc(thing)
    assert doc
    assert re.match(r"\S.*[.]$", doc.splitlines()[0]), doc.splitlines()[0]


@pytest.mark.parametrize("name", [name for name in NAMES if name[0].isupper()])
def test_every_public_class_has_an_example_unless_it_is_a_bare_protocol_or_record(name):
    thing = getattr(torchrl_mpfa, name)
    if getattr(thing, "_is_protocol", False) or name in {"BatchFacts", "SignalTable"}:
        return
    assert "Examples:" in thing.__doc__
    assert ">>>" in thing.__doc__


@pytest.mark.parametrize("name", NAMES)
def test_every_argument_of_a_public_name_is_described(name):
    thing = getattr(torchrl_mpfa, name)
    if getattr(thing, "_is_protocol", False) or getattr(thing, "__init__", 0) is object.__init__:
        return
    function, described = thing, inspect.getdoc(thing)
    if inspect.isclass(thing):
        # TorchRL's metaclasses add arguments of their own to the signature of a class.
        function = thing.__init__
        described = next(each.__doc__ for each in thing.__mro__ if "__init__" in vars(each))
    for parameter in inspect.signature(function).parameters.values():
        kind, word = parameter.kind, parameter.name
        stars = {kind.VAR_POSITIONAL: r"\*", kind.VAR_KEYWORD: r"\*\*"}.get(kind, "")
        if parameter.name in {"args", "self"}:
            continue
        assert re.search(rf"^ *{stars}{word}:", described, re.MULTILINE), f"{name}: {word}"


def test_the_version_is_one():
    assert re.fullmatch(r"\d+\.\d+\.\d+([.-]?\w+)?", torchrl_mpfa.__version__)


ROOT = Path(__file__).parent.parent
_LOOK = """
import sys
from functools import reduce
import {package}
for name in sys.argv[1:]:
    reduce(getattr, name.split("."), {package})
"""
_NEED_ROS = ("ros.policy_node", "ros.robot_node")


def documented(package, alias):
    """Dotted names of modules and what is in them, as the pages have them."""
    pages = {ROOT / "README.md", *(ROOT / "docs").rglob("*.md")}
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    found = set(re.findall(rf"\b(?:{package}|{alias})\.([a-z_]+(?:\.\w+)*)(?=[`(\s])", text))
    files = {
        ".".join(path.relative_to(ROOT / folder / package).with_suffix("").parts)
        for folder in (".", "envs")
        for path in (ROOT / folder / package).rglob("*.py")
    }
    modules = {name for name in found if any(f"{name}.".startswith(f"{file}.") for file in files)}
    return sorted(modules - set(_NEED_ROS))


@pytest.mark.parametrize(
    ("package", "names"),
    [
        ("torchrl_mpfa", ["saving.save_atomically", "methods.her.HindsightGoals"]),
        ("mpfa_envs", ["worlds.barn.barn_world", "deploy.map_path", "generators.generate"]),
    ],
)
def test_a_module_is_there_after_a_bare_import(package, names):
    look(package, names)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "alias"), [("torchrl_mpfa", "mpfa"), ("mpfa_envs", "mpfa_envs")]
)
def test_every_documented_module_is_there_after_a_bare_import(package, alias):
    names = documented(package, alias)
    assert len(names) > 10
    # A later one must not be there because of an earlier one: both orders.
    look(package, names)
    look(package, names[::-1])


def look(package, names):
    code = _LOOK.format(package=package)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *names],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr.splitlines()[-1]


@pytest.mark.parametrize("package", ["torchrl_mpfa", "mpfa_envs"])
def test_an_unknown_name_is_an_attribute_error(package):
    code = f"import {package}\nassert not hasattr({package}, 'no_such_module')"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("kind", [SignalSampler, SignalTensorStorage, SignalTable, CompiledTrees])
def test_what_one_part_says_to_another_is_on_the_page_of_the_design(kind):
    page = (ROOT / "docs/design.md").read_text(encoding="utf-8")
    table = page.split("## What the parts of a buffer say")[1].split("\n## ")[0]
    own = [part for part in kind.__mro__ if part.__module__.startswith("torchrl_mpfa")]
    theirs = {name for part in kind.__mro__ if part not in own for name in vars(part)}
    called = {n for part in own for n, v in vars(part).items() if inspect.isfunction(v)}
    unsaid = {name for name in called - theirs - SAID if not name.startswith("_")}
    assert not {name for name in unsaid if f"`{name}`" not in table}
