"""The documentation site: it is built without a warning and works when opened as a file."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-quic"]
SPHINX = re.compile(r":(?:class|func|meth|attr|data|math):|\.\. math::|={5}")
"""What the pages of the reference would show of docstrings that were not turned to Markdown."""
DESKTOP, PHONE = {"width": 1440, "height": 900}, {"width": 390, "height": 844}
LONGEST = 12_000
"""Height of a page on a desktop [px]."""
NEEDED = "document.documentElement.scrollWidth"
HEIGHT = "document.documentElement.scrollHeight"
CUT = """() => [...document.querySelectorAll(".md-content pre > code, .md-typeset__scrollwrap")]
    .filter((part) => part.scrollWidth > part.clientWidth + 1)
    .map((part) => part.textContent.trim().slice(0, 60))"""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built with warnings as errors."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium without a window."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is of the extra dev")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed, in which to look at the site")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        yield started
        started.close()


def test_the_site_names_nothing_to_load_from_elsewhere(site: Path) -> None:
    loaded = re.compile(r'(?:src="|<link rel="stylesheet" href=")(https?://[^"]+)')
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not loaded.findall(text), page
        assert "arithmatex" not in text, page
    for page in (site / "reference").glob("*.html"):
        assert not SPHINX.search(page.read_text("utf-8")), page


def test_no_page_is_wider_than_its_window_too_long_or_cut_on_a_desktop(
    site: Path, browser: Any
) -> None:
    page = browser.new_page()
    elsewhere: list[str] = []
    page.on("request", lambda request: elsewhere.append(request.url))
    wrong: dict[str, Any] = {}
    for file in sorted(site.rglob("*.html")):
        page.set_viewport_size(DESKTOP)
        page.goto(file.as_uri())
        cut, needed = page.evaluate(CUT), page.evaluate(NEEDED)
        name = file.relative_to(site).as_posix()
        # A file of the repository is as long as it is.
        height = 0 if name.startswith("source/") else page.evaluate(HEIGHT)
        # There code and tables scroll in boxes of their own.
        page.set_viewport_size(PHONE)
        on_phone = page.evaluate(NEEDED)
        wide = needed > DESKTOP["width"] or on_phone > PHONE["width"]
        if cut or wide or height > LONGEST:
            wrong[name] = needed, on_phone, height, cut
    page.close()
    assert wrong == {}
    assert [url for url in elsewhere if not url.startswith(("file:", "data:"))] == []


def test_the_numbers_of_an_interval_stay_on_one_line_and_code_as_it_is(site: Path) -> None:
    tables = (site / "results" / "drivers.html").read_text(encoding="utf-8")
    paper = (site / "results" / "paper.html").read_text(encoding="utf-8")
    assert re.search(r"\[\d[\d.]*%,\xa0[\d.]+%\]", paper) and "0\xa0of\xa011" in paper
    assert not re.search(r"<code>[^<]*\xa0", tables + paper)


def found_by_search(site: Path, browser: Any, words: str) -> list[str]:
    """The pages that the search finds, in its order."""
    page = browser.new_page(viewport=DESKTOP)
    page.goto((site / "index.html").as_uri())
    box = page.locator(".md-search__input")
    assert box.is_visible()
    box.press_sequentially(words)
    page.wait_for_selector(".md-search-result__link", timeout=20_000)
    links = [each.get_attribute("href") for each in page.locator(".md-search-result__link").all()]
    page.close()
    return [re.split("[?#]", link.removeprefix(f"{site.as_uri()}/"))[0] for link in links]


def test_the_search_of_a_site_that_is_opened_as_a_file_finds_pages_and_no_code(
    site: Path, browser: Any
) -> None:
    found = found_by_search(site, browser, "positive_above")
    assert "reference/method_kinds.html" in found
    assert [link for link in found if link.startswith("source/")] == []


@pytest.mark.parametrize("word", ["install", "reproduce", "checkpoint", "resume"])
def test_a_word_of_daily_work_finds_its_page_first(site: Path, browser: Any, word: str) -> None:
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    (page,) = re.findall(rf"^    (\S+)\.md: \[.*\b{word}\b.*\]$", settings, re.MULTILINE)
    assert found_by_search(site, browser, word)[0] == f"{page}.html"


def test_a_picture_of_a_page_is_a_link_to_itself(site: Path, browser: Any) -> None:
    page = browser.new_page(viewport=DESKTOP)
    page.goto((site / "results.html").as_uri())
    page.locator(".md-content img").first.click()
    page.wait_for_url(re.compile(r"\.(?:png|gif)$"))
    page.close()
