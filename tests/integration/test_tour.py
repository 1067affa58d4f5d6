"""The notebook runs from top to bottom, and is stored with what it printed and drew."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import torch

EXAMPLES = Path(__file__).parents[2] / "examples"


def code_cells() -> list[dict[str, Any]]:
    notebook = json.loads((EXAMPLES / "tour.ipynb").read_text(encoding="utf-8"))
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def cells() -> list[str]:
    return ["".join(cell["source"]) for cell in code_cells()]


def test_the_notebook_is_stored_with_its_outputs_without_warnings_and_small() -> None:
    outputs = [output for cell in code_cells() for output in cell["outputs"]]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 4
    printed = ["".join(each["text"]) for each in outputs if each["output_type"] == "stream"]
    assert [text for text in printed if not re.match(r"\d+ episodes, success of", text)] == []
    assert [each for each in outputs if each["output_type"] == "error"] == []
    assert [cell["execution_count"] for cell in code_cells()] == [1, 2, 3, 4, 5, 6]
    assert (EXAMPLES / "tour.ipynb").stat().st_size < 1_000_000


def test_the_training_of_the_notebook_is_a_number_of_whole_batches() -> None:
    text = "\n".join(cells())
    numbers = {
        name: int(value)
        for name, value in re.findall(r"(ACTIONS|frames_per_batch) ?= ?([\d_]+)", text)
    }
    assert numbers["ACTIONS"] % numbers["frames_per_batch"] == 0


@pytest.mark.filterwarnings("ignore")
def test_the_notebook_runs_at_a_small_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(EXAMPLES)
    mpl.use("Agg")
    text = "\n".join(cells())
    for size, small in {"ACTIONS = 6_016": "ACTIONS = 512", "episodes=12": "episodes=3"}.items():
        assert size in text
        text = text.replace(size, small)
    names: dict[str, Any] = {}
    try:
        exec(text, names)
    finally:
        torch.set_flush_denormal(False)
    assert names["learner"].updates == 128
    assert len(names["weights"]) == 4
    # The last line of a cell that shows a picture is an expression, which a notebook displays.
    shown = [cell for cell in cells() if isinstance(ast.parse(cell).body[-1], ast.Expr)]
    assert sum("Image.fromarray" in cell.splitlines()[-1] for cell in shown) == 3
    assert np.asarray(names["picture"](names["trained"], "A", 2)).ndim == 3
