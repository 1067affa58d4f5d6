"""Examples in the docstrings of the scripts' modules run and give what they say."""

from __future__ import annotations

import doctest
import pkgutil
from importlib import import_module

import pytest

import benchmarks.paper
import training

MODULES = [
    module.name
    for package in (benchmarks.paper, training)
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_give_what_they_say(name: str) -> None:
    assert doctest.testmod(import_module(name)).failed == 0


def test_there_are_examples_to_run() -> None:
    finder = doctest.DocTestFinder()
    modules = [import_module(f"benchmarks.paper.{name}") for name in ("page", "runs")]
    found = [each for module in modules for each in finder.find(module)]
    assert sum(bool(each.examples) for each in found) >= 2
