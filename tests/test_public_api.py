"""What the package promises: its names, their docstrings, and examples that run."""

import ast
import inspect
import re
from pathlib import Path

import pytest

import torchrl_mpfa

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
