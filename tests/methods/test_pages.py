"""The examples in the pages of the methods run."""

import re
import warnings
from pathlib import Path

import pytest

from benchmarks.paper.methods import RECONSTRUCTIONS
from torchrl_mpfa.methods import ALIASES, METHODS, Method, make_replay

PAGES = Path(__file__).resolve().parents[2] / "docs/methods"


@pytest.mark.filterwarnings("ignore:No target network updater")
def test_the_examples_of_the_page_run_in_their_order(monkeypatch):
    monkeypatch.setattr("builtins.print", lambda *words: None)
    # What a page adds to the catalogue is gone afterwards.
    monkeypatch.setattr("torchrl_mpfa.methods.METHODS", dict(METHODS))
    names = {"METHODS": dict(METHODS), "Method": Method, "make_replay": make_replay}
    blocks = re.findall(
        r"```python\n(.*?)```", (PAGES / "README.md").read_text(encoding="utf-8"), re.DOTALL
    )
    assert blocks
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for block in blocks:
            exec(block, names)


def test_every_method_has_a_row_and_a_page_or_a_section_of_one():
    table = (PAGES / "README.md").read_text(encoding="utf-8")
    links = dict(re.findall(r"^\| \[`(\w+)`\]\((\S+?)\)", table, re.MULTILINE))
    assert set(links) == {*METHODS, *RECONSTRUCTIONS} - set(ALIASES)
    for name, link in links.items():
        page, _, section = link.partition("#")
        title = f"## `{section}`" if section else f"# `{name}`"
        assert section in ("", name)
        assert re.search(rf"^{title}", (PAGES / page).read_text(encoding="utf-8"), re.MULTILINE)
