"""Fig. 3 of the paper: TD errors and rewards of PER, their rows and what the page says of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import errors
from benchmarks.paper.rows import FOLDER, write_rows
from training.settings.train import register

ROOT = Path(__file__).resolve().parents[2]


def test_runs_are_those_of_per_over_200_episodes_in_world_a() -> None:
    register()
    planned = errors.figure_3(Path("runs"))
    settings = planned.jobs[0].asked(planned.settings)
    [stage] = settings.curriculum.stages
    assert (stage.world, stage.episodes) == ("A", 200)
    assert [job.seed for job in planned.jobs] == list(range(100, 110))
    assert settings.method.name == "per" and settings.regime == "paper"


def test_table_compares_two_parts_of_each_run(tmp_path: Path) -> None:
    episodes = np.arange(1, 201)
    tables = []
    for seed in range(8):
        for measure, late in (("td_error", 2.0), ("reward", 1.0)):
            values = np.where(episodes > 180, late, 1.0) + 0.01 * seed
            rows = {"seed": seed, "measure": measure, "episode": episodes, "value": values}
            tables.append(pd.DataFrame(rows))
    write_rows(pd.concat(tables), tmp_path / errors.FILE)
    rose, stayed = errors.errors_table(tmp_path).splitlines()[2:]
    assert "| 1.00 [1.00, 1.00] | 0.008 | 8 |" in rose
    assert "| 0.00 [0.00, 0.00] | 1.000 | 8 |" in stayed
    assert errors.plot_figure_3(tmp_path, tmp_path / "figure.png")


def test_nothing_is_said_without_rows(tmp_path: Path) -> None:
    assert errors.errors_table(tmp_path) == ""
    assert not errors.plot_figure_3(tmp_path, tmp_path / "figure.png")


@pytest.mark.parametrize("measure", errors.MEASURES)
def test_page_has_the_table_of_the_kept_rows(measure: str) -> None:
    page = (ROOT / FOLDER.parent / "paper.md").read_text(encoding="utf-8")
    made = errors.errors_table(ROOT / FOLDER)
    assert made in page and errors.MEASURES[measure] in made
