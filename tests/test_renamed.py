"""Old names warn, and are what the page of renamed names says."""

from importlib import import_module
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs/reference/renamed.md"
ROWS = [
    tuple(cell.strip(" `") for cell in line.strip("|").split("|"))
    for line in PAGE.read_text(encoding="utf-8").splitlines()
    if line.startswith("| `")
]
GONE = [
    tuple(part.strip("- `") for part in line.split(": "))
    for line in PAGE.read_text(encoding="utf-8").splitlines()
    if line.startswith("- `")
]


def found(path):
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


@pytest.mark.parametrize(("old", "new"), ROWS)
def test_an_old_name_warns_and_is_the_new_one(old, new):
    with pytest.warns(DeprecationWarning, match=f"{old} is now {new}"):
        value = found(old)
    assert value is found(new)


def test_every_old_name_is_on_the_page():
    from mpfa_envs import _RENAMED
    from torchrl_mpfa.renamed import OF_CLIFFWALK, OF_LEARNERS, OF_METHODS, OF_SELECTION, TOP

    tables = (_RENAMED, OF_LEARNERS, OF_METHODS, OF_SELECTION, TOP)
    assert len(ROWS) == sum(map(len, tables))
    assert len(GONE) == len(OF_CLIFFWALK)


@pytest.mark.parametrize(("old", "new"), GONE)
def test_a_name_that_left_the_package_tells_where_it_went(old, new):
    with pytest.raises(AttributeError, match=f"{old} is now {new}, which is not installed"):
        found(old)
    assert found(new)


@pytest.mark.parametrize("package", ["torchrl_mpfa", "torchrl_mpfa.methods", "mpfa_envs"])
def test_a_name_that_never_was_is_no_attribute(package):
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        import_module(package).nothing  # noqa: B018
