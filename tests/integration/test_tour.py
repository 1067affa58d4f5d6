"""The notebook runs from top to bottom."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import torch

EXAMPLES = Path(__file__).parents[2] / "examples"


def cells() -> list[str]:
    notebook = json.loads((EXAMPLES / "tour.ipynb").read_text(encoding="utf-8"))
    assert all(not cell.get("outputs") for cell in notebook["cells"]), "clear the outputs"
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


@pytest.mark.filterwarnings("ignore")
def test_the_notebook_runs_at_a_small_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(EXAMPLES)
    mpl.use("Agg")
    text = "\n".join(cells())
    for size, small in {"ACTIONS = 6_000": "ACTIONS = 512", "episodes=12": "episodes=3"}.items():
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
