"""What the tests of the scripts share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hydra.core.config_store import ConfigStore


@pytest.fixture(scope="session", autouse=True)
def one_store() -> Iterator[None]:
    """Hydra copies all settings that it knows to compose some: 0.1 s, as often as tests do so."""
    with pytest.MonkeyPatch.context() as patch:
        # What is loaded from the store is a copy in any case.
        patch.setattr(ConfigStore, "__deepcopy__", lambda store, _: store, raising=False)
        yield


@pytest.fixture
def tables_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the report of a study make no figure, which takes longer than all of its tables."""
    monkeypatch.setattr("report.plot_evaluations", lambda *_: None)
