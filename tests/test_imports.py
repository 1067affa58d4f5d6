"""Documented names in a fresh process that has imported the package and nothing else."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

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
