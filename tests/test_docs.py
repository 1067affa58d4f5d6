"""The documentation: its pages are found, its links lead somewhere, its code runs."""

from __future__ import annotations

import pkgutil
import re
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml

import mpfa_envs
import torchrl_mpfa
import torchrl_mpfa.methods
from mpfa_envs import (
    EXAMPLE_ROBOT,
    Policy,
    World,
    deploy,
    export_policy,
    load_policy,
    load_robot,
    load_world,
    planners,
    render,
)

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
TEXTS = ["../README.md", "../CONTRIBUTING.md", *PAGES]
LINK = re.compile(r"\]\((?!\w+:)([^)#\s]*)(?:#([^)\s]+))?\)")
ITEM = r"^(?:[-*]|\d+\.) .*\n"
PART_OF_A_LIST = re.compile(ITEM + r"(?: .*\n)*\n+    [^`\s].*", re.MULTILINE)
"""An indented line after a list, which is a paragraph of its last item."""
NO_LIST = re.compile(r"^(?![-*|#>]|\d+\. )\S.*\n" + ITEM, re.MULTILINE)
"""An item right after a line of text, which is a list in the repository, but not on the site."""


def without_code(text: str) -> str:
    return re.sub(r"^(```+).*?^\1", "", text, flags=re.DOTALL | re.MULTILINE)


def slugs(page: Path) -> set[str]:
    """Anchors of a page that are the same in the repository and on the site."""
    found = re.findall(r"^#+ (.+)$", without_code(page.read_text(encoding="utf-8")), re.MULTILINE)
    shown = [re.sub(r"\[([^]]*)\]\([^)]*\)|[`*]", r"\1", title).lower() for title in found]
    repository = {re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", title)) for title in shown}
    plain = [unicodedata.normalize("NFKD", title).encode("ascii", "ignore") for title in shown]
    words = [re.sub(r"[^\w\s-]", "", title.decode()).strip() for title in plain]
    return repository & {re.sub(r"[-\s]+", "-", title) for title in words}


def entries(nav: object) -> Iterator[str]:
    """Pages of a part of the navigation."""
    if isinstance(nav, str):
        yield nav
    elif isinstance(nav, dict):
        for each in nav.values():
            yield from entries(each)
    else:
        for each in nav:
            yield from entries(each)


def test_every_page_is_in_the_navigation_once() -> None:
    nav = list(entries(yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]))
    # The first page is the README; the notebook lies among the examples.
    assert sorted(nav) == sorted([*PAGES, "index.md", "notebook.md"])


@pytest.mark.parametrize("page", TEXTS)
def test_every_link_of_a_page_leads_somewhere(page: str) -> None:
    path = (DOCS / page).resolve()
    for link, anchor in LINK.findall(without_code(path.read_text(encoding="utf-8"))):
        target = (path.parent / link).resolve() if link else path
        assert target.exists(), link
        assert target.is_relative_to(ROOT), link
        if anchor:
            assert anchor in slugs(target), f"{link}#{anchor}"


def test_code_after_a_list_is_fenced_and_a_list_begins_after_an_empty_line() -> None:
    texts = {page: without_code((DOCS / page).read_text(encoding="utf-8")) for page in TEXTS}
    found = {
        page: [match[0] for rule in (PART_OF_A_LIST, NO_LIST) for match in rule.finditer(text)]
        for page, text in texts.items()
    }
    assert {page: wrong for page, wrong in found.items() if wrong} == {}


@pytest.mark.parametrize(
    ("package", "names"),
    [
        ("torchrl_mpfa", torchrl_mpfa.__all__),
        ("torchrl_mpfa.methods", torchrl_mpfa.methods.__all__),
        ("mpfa_envs", mpfa_envs.__all__),
        ("mpfa_envs.deploy", deploy.__all__),
        ("mpfa_envs.planners", planners.__all__),
        ("mpfa_envs.render", render.__all__),
    ],
)
def test_every_public_name_is_in_the_reference_once(package: str, names: list[str]) -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md"))
    listed = re.findall(r"^::: ([\w.]+)$", pages, re.MULTILINE)
    # What a package takes from one of its folders may be listed as that folder's.
    counts = {
        name: len([each for each in listed if re.search(rf"\.{name}$", each)]) for name in names
    }
    assert {name for name in names if counts[name] != 1} == set()


def test_every_name_of_the_reference_can_be_resolved() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md"))
    missing = []
    for name in re.findall(r"^::: ([\w.]+)$", pages, re.MULTILINE):
        try:
            pkgutil.resolve_name(name)
        except (AttributeError, ImportError):
            missing.append(name)
    assert missing == []


SMALL = {
    "24_064": "1_280",
    "100_000": "2_000",
    "6_400": "640",
    "width=64": "width=8",
    "episodes=40": "episodes=2",
    "episodes=12": "episodes=2",
}
"""The tutorial's sizes, and those at which the tests run it."""


EPISODES = {
    "planners.md": {"episodes=5": "episodes=1"},
    "tasks.md": {"episodes=50": "episodes=1"},
    "policies.md": {'"test")))': '"test", episodes=1)))'},
}
"""The episodes that other pages evaluate, and those that the tests do."""

HOWTO = [p for p in PAGES if p.startswith("howto/") and p != "howto/robot.md"]
TASK_PAGES = [
    "barn.md",
    "discrete.md",
    "environments/navigation.md",
    "environments/rooms.md",
    "moving.md",
    "noise.md",
    "pictures.md",
    "planners.md",
    "policies.md",
    "tasks.md",
    "teams.md",
    "traps.md",
    "vector.md",
    "worlds.md",
]
ELSEWHERE = [
    *("methods/README.md", "methods/her.md", "metrics.md"),
    *("torchrl_trainer.md", "results/values.md", "tuning.md"),
]
"""Pages whose code is run by the tests of what they are about."""

BOX = """<sdf><world name="w"><model name="m"><static>1</static><link name="l"><collision name="c">
<geometry><box><size>1 1 1</size></box></geometry></collision></link></model></world></sdf>"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the code of a page runs, with the files that it reads."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "world_1.world").write_text(BOX)
    World(name="office").to_map(tmp_path / "office.yaml", resolution=0.1)
    return tmp_path


def run(page: str, changes: dict[str, str]) -> dict[str, Any]:
    """Run the code of a page in its order, with smaller sizes; the names that it leaves."""
    names: dict[str, Any] = {}
    text = (DOCS / page).read_text(encoding="utf-8")
    for size, small in changes.items():
        assert size in text
        text = text.replace(size, small)
    try:
        for block in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            exec(block, names)
    finally:
        torch.set_flush_denormal(False)
    return names


def test_the_code_of_the_tutorial_runs_without_a_warning(folder: Path) -> None:
    names = run("tutorial.md", SMALL)
    # Of other sizes TorchRL warns that it collects more than it is asked for.
    text = (DOCS / "tutorial.md").read_text(encoding="utf-8")
    actions, at_once = (
        int(re.findall(rf"{name} ?= ?([\d_]+)", text)[0])
        for name in ("ACTIONS", "frames_per_batch")
    )
    assert actions % at_once == 0
    assert names["learner"].updates == 256
    assert set(names["paths"]) == {0, 1}
    assert (folder / "policy.npz").exists()
    assert (folder / "paths.png").exists()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("page", [*HOWTO, *TASK_PAGES])
@pytest.mark.usefixtures("folder")
def test_the_code_of_a_page_runs_in_its_order(page: str) -> None:
    names = run(page, EPISODES.get(page, {}))
    if page in HOWTO and "buffer" in names:
        # The last buffer of a page was learned from.
        assert names["buffer"].sampler.weights


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_arrays_on_the_page_on_offline_data_are_stored_and_change_the_priorities() -> None:
    names = run("howto/offline.md", {})
    stored, data = names["buffer"][:], names["data"]
    for key, array in (
        ("observation", "observations"),
        ("action", "actions"),
        (("next", "observation"), "next_observations"),
        (("next", "reward"), "rewards"),
        (("next", "terminated"), "terminals"),
        (("next", "truncated"), "timeouts"),
    ):
        np.testing.assert_array_equal(stored[key].squeeze(-1), data[array])
    ended = data["terminals"] | data["timeouts"]
    np.testing.assert_array_equal(stored["next", "done"].squeeze(-1), ended)
    columns = names["buffer"].distributions()
    assert columns["td_error"].isfinite().sum() > names["UPDATES"]
    assert len(columns["priority"].unique()) > names["UPDATES"]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seed", [1, 2])
def test_pieces_and_sums_on_the_page_on_sequences_are_of_one_trajectory(seed: int) -> None:
    torch.manual_seed(seed)
    names = run("howto/sequences.md", {"seed=0": f"seed={seed}"})
    for _ in range(10):
        pieces = names["slices"].sample().reshape(-1, 8)
        assert pieces["next", "observation"][:, :-1].equal(pieces["observation"][:, 1:])
    stored = names["buffer"][:]
    place = torch.arange(stored.shape[1]) % 20  # Of the twenty steps of a rollout.
    assert bool((place + stored["steps_to_next_obs"] <= 20).all())


def test_the_pilot_on_the_page_on_robots_decides_by_scans(folder: Path) -> None:
    pytest.importorskip("onnx", reason="exported policies are of the extra onnx")
    export_policy(load_policy("td3-paper"), folder / "policy.onnx")
    control = run("robot.md", {})["control"]
    message = SimpleNamespace(
        angle_min=-np.pi, angle_increment=0.01, ranges=np.full(629, 3.0), range_min=0.1
    )
    message.range_max = 12.0
    command = control(message, (0.0, 0.0, 0.0), (0.0, 0.0))
    # The goal lies to the left.
    assert command.right > command.left > 0.0
    assert control(message, (3.0, 0.8, 0.0), (0.3, 0.0)) is None


def test_the_page_on_your_robot_has_the_example_and_its_pilot_reads_the_card(folder: Path) -> None:
    pytest.importorskip("onnx", reason="exported policies are of the extra onnx")
    text = (DOCS / "howto" / "robot.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"^```yaml\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert example == EXAMPLE_ROBOT.read_text(encoding="utf-8")
    (folder / "cart.yaml").write_text(example, encoding="utf-8")
    (folder / "runs" / "cart").mkdir(parents=True)
    layers = [torch.nn.Linear(42, 2), torch.nn.Tanh()]
    untrained = Policy.from_layers(layers, env_arguments={"robot": "cart.yaml"})
    export_policy(untrained, folder / "runs" / "cart" / "policy.onnx")
    names = run("howto/robot.md", {})
    assert names["pilot"].robot == load_robot(EXAMPLE_ROBOT)
    assert names["pilot"].sectors.mount == (0.1, 0.0, 0.0)
    assert load_world("plan.yaml").size == pytest.approx(names["plan"].size, abs=0.2)


def test_no_page_has_code_that_is_not_run() -> None:
    have = {page for page in PAGES if "```python\n" in (DOCS / page).read_text(encoding="utf-8")}
    assert have - {*HOWTO, *TASK_PAGES, *ELSEWHERE} == {"tutorial.md", "robot.md", "howto/robot.md"}


CODE = re.compile(r"^(```+).*?^\1|<!--.*?-->|\$\$.*?\$\$", re.DOTALL | re.MULTILINE)
NO_PROSE = re.compile(r"\s*(?:\||!\[|<|[-|=+:]{4,}$)|#+ ")
"""A line of a table, a picture, a tag of HTML, a rule or a title."""
SHOWN = (
    (re.compile(r"\$[^$]*\$|`[^`]*`"), "CODE"),
    (re.compile(r"\[([^\]]*)\]\([^)]*\)"), r"\1"),
    (re.compile(r"<[^>]+>|[*_]{1,3}"), ""),
    (re.compile(r"https?://\S+"), "URL"),
    (re.compile(r"\b(e\.g|i\.e|Eqs?|Figs?|vs|al|cf)\."), r"\1"),
)
"""What a reader sees of markup."""
WORD = re.compile(r"[A-Za-z][A-Za-z'’-]*|\d[\d.,]*")
NUMBER = re.compile(r"(?<![A-Za-z])[\d−-]?\d[\d.,]*")
FEWEST_WORDS = 4
"""Words of the shortest sentence; fewer are a label."""
RESULTS = ("results.md", "results/")
GUIDES = ("results.md", "results/study.md", "results/tables.md")
"""Pages of results that lead to others, or say how they were made, or have many questions."""
LIMITS = {"readme": (15.0, 0.05, 0.2), "page": (15.0, 0.05, 0.3), "results": (18.0, 0.08, 0.8)}
"""Words a sentence, share of sentences of more than thirty words, numbers a sentence."""


def sentences(text: str) -> list[str]:
    """Sentences of the prose of a page: no code, tables, titles or pictures."""
    found = []
    for block in re.split(r"\n[ \t]*\n|\n(?=[ \t]*(?:[-*+]|\d+\.) )", CODE.sub("\n\n", text)):
        if block.strip("\n").startswith("    ") and not re.match(r"\s*([-*+]|\d+\.) ", block):
            continue
        lines = [line.strip() for line in block.splitlines() if not NO_PROSE.match(line)]
        line = re.sub(r"^([-*+]|\d+\.) ", "", " ".join(lines))
        for markup, shown in SHOWN:
            line = markup.sub(shown, line)
        found += re.split(r"(?<=[.!?])\s+(?=[A-Z\"“(\d])", line)
    return [each for each in found if len(WORD.findall(each)) >= FEWEST_WORDS]


def measured(text: str) -> tuple[float, float, float]:
    """Words a sentence, share of more than thirty words, and numbers a sentence."""
    words = [len(WORD.findall(each)) for each in sentences(text)]
    numbers = [len(NUMBER.findall(each)) for each in sentences(text)]
    count = max(len(words), 1)
    return sum(words) / count, sum(each > 30 for each in words) / count, sum(numbers) / count


def test_prose_is_measured_without_code_tables_and_titles() -> None:
    text = "# Title\n\nOne of `two words` has 3 numbers, 0.5 and 7. Here are four more."
    text += "\n\n| a table of 9 words | is no prose |\n\n    code with 8 numbers\n"
    text += "\n- An item [of a list](page.md) is\n  prose.\n\n```bash\nmake 1 2 3 4 5\n```\n"
    assert [len(WORD.findall(each)) for each in sentences(text)] == [9, 4, 7]
    assert measured(text) == (20 / 3, 0.0, 1.0)


@pytest.mark.parametrize("page", TEXTS)
def test_sentences_are_short_and_have_few_numbers(page: str) -> None:
    text = (DOCS / page).read_text(encoding="utf-8")
    kind = "results" if page.startswith(RESULTS) else "page"
    limits = LIMITS["readme" if page == "../README.md" else kind]
    found = measured(text)
    assert all(each <= limit for each, limit in zip(found, limits, strict=True)), (found, limits)


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.startswith(RESULTS) and page not in GUIDES]
)
def test_a_page_of_results_begins_with_what_was_found(page: str) -> None:
    check_summary((DOCS / page).read_text(encoding="utf-8").split("\n## ")[0])


def test_each_table_of_the_study_begins_with_what_was_found() -> None:
    _, *tables = (DOCS / "results/tables.md").read_text(encoding="utf-8").split("\n## ")
    assert len(tables) == 10
    for table in tables:
        check_summary(table)


def check_summary(text: str) -> None:
    said = re.findall(r"^- \*\*(.+?)\.\*\* ", text, re.MULTILINE)
    assert said[:4] == ["Question", "Answer", "How sure", "Changed after the start"]


def test_the_page_of_results_is_read_once() -> None:
    assert len((DOCS / "results.md").read_text(encoding="utf-8").split()) <= 1_200
