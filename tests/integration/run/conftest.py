"""What the tests of a run share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from training import figures


@pytest.fixture(autouse=True)
def empty_curves(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Leave an empty file for a learning curve, which takes longer to draw than a tiny run."""
    draw = figures.plot_learning_curve

    def touch(_: Any, path: Path) -> None:
        path.touch()

    monkeypatch.setattr(figures, "plot_learning_curve", touch)
    return draw


@pytest.fixture
def drawn_curves(empty_curves: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw learning curves nevertheless."""
    monkeypatch.setattr(figures, "plot_learning_curve", empty_curves)
