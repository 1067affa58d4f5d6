"""What the tests of the scripts share."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from hydra.core.config_store import ConfigStore

from training import pictures
from training.records import write_table
from training.settings.train import register


@pytest.fixture(scope="session", autouse=True)
def one_store() -> Iterator[None]:
    """Hydra copies all settings that it knows to compose some: 0.1 s, as often as tests do so.

    Each script makes them known anew, which takes as long: those that are known as they are stay.
    """
    store, known = ConfigStore.store, dict[Any, Any]()

    def store_once(self: ConfigStore, name: str, node: Any, **place: Any) -> None:
        group, told = place.get("group"), (type(node), repr(node), place)
        there = f"{name}.yaml" in (self.repo.get(group, {}) if group else self.repo)
        if not there or known.get((group, name)) != told:
            store(self, name, node, **place)
            known[group, name] = told

    with pytest.MonkeyPatch.context() as patch:
        # What is loaded from the store is a copy in any case.
        patch.setattr(ConfigStore, "__deepcopy__", lambda store, _: store, raising=False)
        patch.setattr(ConfigStore, "store", store_once)
        register()
        yield


@pytest.fixture(scope="session", autouse=True)
def short_films() -> Iterator[None]:
    """Film an episode in nine pictures: a hundred of them take longer than all else of a run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "film_episode", partial(pictures.film_episode, most=8))
        yield


@pytest.fixture(autouse=True)
def denormal_numbers() -> Iterator[None]:
    """Keep denormal numbers, which scripts treat as zero, for the tests that come after."""
    yield
    torch.set_flush_denormal(False)


@pytest.fixture
def tables_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the report of a comparison make no figure, which takes longer than all of its tables."""
    monkeypatch.setattr("training.comparison.report.plot_evaluations", lambda *_: None)


@pytest.fixture
def comparison(tmp_path: Path) -> Path:
    """Two methods, two seeds, four pairs: the first method fails once, the other always."""
    evaluation = []
    for method, failures in (("mpfa_per", {(1, 3)}), ("per", None)):
        for seed in (0, 1):
            for episode in range(4):
                good = failures is not None and (seed, episode) not in failures
                evaluation.append(
                    {
                        **{"learner": "ddpg", "method": method, "seed": seed, "world": "test"},
                        **{"episode": episode, "success": good, "collision": not good},
                        **{"timeout": False, "time_s": 20.0 + seed, "spl": 0.8 * good},
                    }
                )
            folder = tmp_path / f"ddpg-{method}-{seed}"
            folder.mkdir()
            training = [
                {"total_steps": 10 * (n + 1), "success": n > 1, "average_reward": 0.1 * n}
                for n in range(5)
            ]
            write_table(pd.DataFrame(training), folder / "episodes.csv")
            found = [{"total_steps": 5000, "success": 0.5}, {"total_steps": 9000, "success": 1}]
            write_table(pd.DataFrame(found), folder / "evaluations.csv")
    write_table(pd.DataFrame(evaluation), tmp_path / "episodes.csv")
    return tmp_path
