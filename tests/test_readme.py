"""The README: its code runs, its commands and links exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from torchrl_mpfa.methods import METHODS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")
def test_the_first_code_trains_and_prints_three_different_shares(
    capsys: pytest.CaptureFixture[str],
) -> None:
    names: dict[str, object] = {}
    exec(BLOCKS[0], names)
    assert names["learner"].updates == 40
    printed = ast.literal_eval(capsys.readouterr().out)
    assert {name.split("/")[1] for name in printed} == {"reward", "td_error", "action_gradient"}
    # The entropy weights of the latter two are equal by definition, which looks like a mistake.
    assert len(set(printed.values())) == 3
    assert sum(printed.values()) == pytest.approx(1.0)
    names["env"].close()


def test_the_first_code_has_ten_lines_at_most() -> None:
    assert len(BLOCKS[0].strip().splitlines()) <= 10


def test_its_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"(?:^|`| )make ([a-z-]+)", README, re.MULTILINE))
    assert {"demo", "test"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_no_line_is_longer_than_a_page_is_wide() -> None:
    assert [line for line in README.splitlines() if len(line) > 120] == []


def test_it_has_one_example_and_110_lines_at_most() -> None:
    assert len(BLOCKS) == 1
    assert len(README.splitlines()) <= 110


def test_number_of_methods_is_that_of_the_catalogue() -> None:
    for page in ("README.md", "docs/peers.md", ".ci/site_cards.md"):
        assert f"{len(METHODS)} named methods" in (ROOT / page).read_text(encoding="utf-8")
