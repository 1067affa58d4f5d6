"""Figures, looked at: where their lines, bars and marks are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from training.figures import plot_evaluations, plot_learning_curve

BLUE, ORANGE, GRAY = (0, 114, 178), (230, 159, 0), (128, 128, 128)


def colored(path: Path, color: tuple[int, int, int], *, spread: int = 12) -> NDArray[np.bool_]:
    """Which pixels of a picture have about this color, shape ``[height, width]``."""
    with Image.open(path) as picture:
        found = np.asarray(picture.convert("RGB")).astype(int)
    return (abs(found - color) <= spread).all(-1)


def heights(panel: NDArray[np.bool_], *, quarter: int) -> float:
    """Mean height, from 0 at the bottom to 1, of the marked pixels in a quarter of the width."""
    width = panel.shape[1] // 4
    rows = np.nonzero(panel[:, quarter * width : (quarter + 1) * width])[0]
    assert len(rows) > 10
    return 1.0 - float(rows.mean()) / len(panel)


def episodes(*, learned: bool) -> pd.DataFrame:
    """Forty episodes in two worlds, the second half with success and a higher reward."""
    good = np.arange(40) >= 20
    return pd.DataFrame(
        {
            "world": np.where(good, "B", "A"),
            "success": good & learned,
            "average_reward": np.where(good & learned, 0.5, 0.1),
            "total_steps": 100 * np.arange(1, 41),
        }
    )


def test_a_learning_curve_rises_where_the_run_learned_and_marks_the_new_world(
    tmp_path: Path,
) -> None:
    path = tmp_path / "curve.png"
    plot_learning_curve(episodes(learned=True), path, window=1)
    line = colored(path, BLUE)
    half = len(line) // 2
    for panel in (line[:half], line[half:]):
        assert heights(panel, quarter=1) + 0.3 < heights(panel, quarter=3)
    # A dotted line from top to bottom between episodes 20 and 21, near the middle.
    marked = colored(path, GRAY, spread=40)[: half - 40].sum(0)
    assert abs(int(marked.argmax()) / line.shape[1] - 0.55) < 0.06
    same = episodes(learned=True).assign(world="A")
    plot_learning_curve(same, tmp_path / "same.png", window=1)
    assert colored(tmp_path / "same.png", GRAY, spread=40)[: half - 40].sum(0).max() < marked.max()


def test_evaluations_are_at_their_steps_and_rates(tmp_path: Path) -> None:
    path = tmp_path / "evaluations.png"
    up = pd.DataFrame({"total_steps": [1000, 5000, 9000], "success": [0.0, 0.5, 1.0]})
    down = pd.DataFrame({"total_steps": [1000, 5000, 9000], "success": [1.0, 0.5, 0.0]})
    plot_evaluations({"up": {"0": up}, "down": {"0": down}}, path)
    rising, falling = (colored(path, color, spread=30) for color in (BLUE, ORANGE))
    assert heights(rising, quarter=0) < 0.4 < 0.6 < heights(rising, quarter=3)
    assert heights(falling, quarter=3) < 0.4 < 0.6 < heights(falling, quarter=0)
