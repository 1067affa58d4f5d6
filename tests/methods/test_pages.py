"""The examples in the pages of the methods run."""

import re
import warnings
from pathlib import Path

import pytest

from torchrl_mpfa.methods import ALIASES, METHODS, Method, make_replay

PAGES = Path(__file__).resolve().parents[2] / "docs/methods"


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("page", ["README.md", "mpfa_per.md"])
def test_examples_of_a_page_run_in_their_order(page, monkeypatch):
    monkeypatch.setattr("builtins.print", lambda *words: None)
    # What a page adds to the catalogue is gone afterwards.
    monkeypatch.setattr("torchrl_mpfa.methods.METHODS", dict(METHODS))
    names = {"METHODS": dict(METHODS), "Method": Method, "make_replay": make_replay}
    blocks = re.findall(
        r"```python\n(.*?)```", (PAGES / page).read_text(encoding="utf-8"), re.DOTALL
    )
    assert blocks
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for block in blocks:
            exec(block, names)


def test_every_method_has_a_page_and_a_row():
    table = (PAGES / "README.md").read_text(encoding="utf-8")
    for name in set(METHODS) - set(ALIASES):
        assert f"[`{name}`]({name}.md)" in table
        assert (PAGES / f"{name}.md").exists()
