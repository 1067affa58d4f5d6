"""The names of logged numbers are those of the page on metrics."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.integration.tiny_runs import tiny
from training.run.loop import TrainingRun
from training.settings.train import Stage, TrainSettings

ROOT = Path(__file__).parents[3]


def of_evaluations(settings: TrainSettings) -> None:
    settings.evaluation = replace(settings.evaluation, every=10, world="A", episodes=1)
    settings.tracking.pictures_every = 0


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """The names that runs of all kinds log."""
    found: set[str] = set()

    class Names:
        def log(self, entries: Mapping[str, Any], actions: int) -> None:
            found.update(entries)

        def flush(self) -> None: ...

        def close(self) -> None: ...

    def nothing(_: TrainSettings) -> None: ...

    kinds: list[tuple[str, str, Callable[[TrainSettings], None]]] = [
        ("mpfa_per", "ddpg", of_evaluations),
        ("hvper", "td3", nothing),
        ("per", "sac", nothing),
        ("ddpg_radam", "ddpg", nothing),
        ("mpfa_per", "dqn", nothing),
        ("mpfa_per", "q_learning", nothing),
    ]
    for method, learner, change in kinds:
        settings = tiny(method, [Stage("A", 3)], learner)
        settings.tracking.log_every, settings.tracking.pictures_every = 1, None
        change(settings)
        run = TrainingRun(settings, tmp_path_factory.mktemp(method))
        run.tracker._logs.append(Names())
        run.tracker.shows = settings.tracking.pictures_every is not None
        run.train()
        run.close()
    return found


@pytest.fixture(scope="module")
def documented() -> set[str]:
    """The names on the page, as patterns."""
    text = (ROOT / "docs/metrics.md").read_text()
    names = re.findall(r"`((?:train|time|policy|loss|replay|priorities|evaluation)/[^`]+)`", text)
    return {name.replace("SIGNAL", "[a-z_]+") for name in names if not name.endswith("/")}


def test_every_name_that_is_logged_is_documented(logged: set[str], documented: set[str]) -> None:
    unknown = {name for name in logged if not any(re.fullmatch(d, name) for d in documented)}
    assert not unknown


def test_every_name_that_is_documented_is_logged(logged: set[str], documented: set[str]) -> None:
    unused = {d for d in documented if not any(re.fullmatch(d, name) for name in logged)}
    assert not unused


def test_the_tables_of_the_page_have_as_many_cells_in_every_row() -> None:
    widths: dict[int, set[int]] = defaultdict(set)
    table = 0
    for line in (ROOT / "docs/metrics.md").read_text().splitlines():
        table += not line.startswith("|")
        if line.startswith("|"):
            widths[table].add(len(re.findall(r"(?<!\\)\|", line)))
    assert widths and all(len(each) == 1 for each in widths.values())
