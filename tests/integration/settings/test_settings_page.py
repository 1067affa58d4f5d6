"""The page of all settings."""

from __future__ import annotations

import runpy
from pathlib import Path

ROOT = Path(__file__).parents[3]
SCRIPT = runpy.run_path(str(ROOT / ".ci" / "settings_page.py"))
PAGE = (ROOT / "docs" / "reference" / "settings.md").read_text(encoding="utf-8")


def test_the_page_has_every_setting_with_the_defaults_that_hold_in_each_regime() -> None:
    assert SCRIPT["page"]() == PAGE, "run: python .ci/settings_page.py"
    for row in (
        "| `robots` | rooms: `16`<br>paper: `1` |",
        "| `learner.tau` | rooms: `0.005`<br>paper: `0.01` |",
        "| `evaluation.world` | rooms: `mazes:validation`<br>paper: `validation` |",
        "| `method.alpha` | `0.6` |",
    ):
        assert row in PAGE
