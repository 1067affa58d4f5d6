"""The page of each environment: its tables say what the code does."""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium
import pytest

from mpfa_envs import ENV_IDS, PAPER_TASK, ROOMS_TASK, TaskConfig

PAGES = Path(__file__).parents[1] / "docs/environments"
IDS = {"rooms.md": "mpfa/Rooms-v1", "navigation.md": "mpfa/Navigation-D-v1"}


def cells(page: str, title: str) -> list[list[str]]:
    """Rows of the first table below a title of a page, without its head."""
    text = (PAGES / page).read_text(encoding="utf-8").partition(f"## {title}\n")[2]
    rows = re.findall(r"^\| (.*) \|$", text.partition("\n## ")[0], re.MULTILINE)
    return [[cell.strip("` ") for cell in re.split(r" \| ?", row)] for row in rows[1:]]


@pytest.mark.parametrize("page", IDS)
def test_the_observation_has_the_parts_of_the_page(page: str) -> None:
    env = gymnasium.make(IDS[page], physics="kinematic")
    config: TaskConfig = env.get_wrapper_attr("config")
    shape = re.search(r"`Box` of shape `\[(\d+)\]`", (PAGES / page).read_text(encoding="utf-8"))
    assert shape is not None
    assert env.observation_space.shape == (int(shape[1]),)
    shown = {}
    for index, name, *_ in cells(page, "Observation"):
        first, _, last = index.partition("-")
        shown[name] = slice(int(first), int(last or first) + 1)
    assert shown == config.observation_slices
    for _, name, *_, between in cells(page, "Observation"):
        low, high = re.fullmatch(r"(\S+) (?:to|and) (\S+)", between).groups()  # type: ignore[union-attr]
        part = config.observation_slices[name]
        assert env.observation_space.low[part].min() == float(low)  # type: ignore[attr-defined]
        if high != "above":
            assert env.observation_space.high[part].max() == float(high)  # type: ignore[attr-defined]
    env.close()


def test_the_rooms_have_the_arguments_of_the_page() -> None:
    shown = {name: value for name, value, _ in cells("rooms.md", "Arguments")}
    (paid,) = ROOMS_TASK["reward"].keywords.items()
    words = ROOMS_TASK | {"reward": "{}={}".format(*paid)}
    assert shown == {name: str(value) for name, value in words.items()}


def test_the_papers_task_differs_by_the_arguments_of_the_page() -> None:
    shown = {name: (usual, paper) for name, usual, paper in cells("navigation.md", "Arguments")}
    assert set(shown) == set(PAPER_TASK)
    for name, (usual, paper) in shown.items():
        assert float(usual.removesuffix(" m")) == getattr(TaskConfig(), name)
        assert float(paper.removesuffix(" m")) == pytest.approx(PAPER_TASK[name])


def test_every_id_of_the_page_is_known() -> None:
    text = (PAGES / "navigation.md").read_text(encoding="utf-8")
    named = re.findall(r"`(mpfa/[\w-]+)`", text)
    assert len(named) > 3
    assert set(named) <= set(ENV_IDS)
