"""What makes one set of pages work in the repository and on the site.

The site's first page is the README, with cards in place of its list of pages. The notebook is a
page with its outputs. A page may link to any file of the repository: such a file becomes a page
with its text, which the search leaves out. Formulas become MathML, which browsers show without a
script, and a picture is a link to itself. The title of the site has the version, and its foot a
link to the repository, where ``REPOSITORY_URL`` says which.
"""

from __future__ import annotations

import html
import json
import os
import posixpath
import re
from pathlib import Path, PurePosixPath

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
_PLACES = {"README.md": "index.md", "examples/tour.ipynb": "notebook.md"}
_LIST_OF_PAGES = re.compile(r"^## What is where\n.*?(?=^## )", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)(#[^)\s]*)?(?=\))")
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
_PICTURE = re.compile(r'(<a\b[^>]*>\s*)?<img\b[^>]*?\bsrc="([^"]+)"[^>]*>')
_ROW = re.compile(r"^\|.*", re.MULTILINE)
_TOGETHER = re.compile(
    r"`[^`]*`|(?<=,) (?=[-+−]?[\d,.]+%?\])|(?<=\d) (?=of \d)|(?<=\d of) (?=\d)|(?<=<) (?=\d)"
)
"""Spaces within an interval, "n of m" and "< p"; and code, which stays as it is."""
_LANGUAGES = {".py": "python", ".yaml": "yaml", ".toml": "toml"}


def linked_files(text: str, folder: str) -> set[str]:
    """Files outside of ``docs/``, and folders, that a page links to.

    Args:
        text: The page.
        folder: Where the page is in the repository.

    Returns:
        Their paths in the repository, of those that exist.
    """
    paths = {posixpath.normpath(posixpath.join(folder, link)) for link, _ in _LINK.findall(text)}
    return {path for path in paths if not _is_on_site(path) and (ROOT / path).exists()}


def place(path: str) -> str:
    """Where a path of the repository is among the pages of the site."""
    if path in _PLACES:
        return _PLACES[path]
    if _is_on_site(path):
        return path.removeprefix("docs/")
    if (ROOT / path).is_dir():
        return f"source/{path}/index.md"
    return f"source/{path}" if path.endswith(".md") else f"source/{path}.md"


def relinked(text: str, folder: str, page: str) -> str:
    """A page with its links as the site needs them.

    Args:
        text: The page.
        folder: Where it is in the repository.
        page: Where it is among the pages of the site.

    Returns:
        The page.
    """

    def moved(link: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(folder, link[1]))
        if not (ROOT / path).exists():
            return link[0]
        return posixpath.relpath(place(path), posixpath.dirname(page) or ".") + (link[2] or "")

    return _LINK.sub(moved, text)


def home_page() -> str:
    """The README with cards, at its first heading, in place of its list of pages."""
    cards = (ROOT / ".ci" / "site_cards.md").read_text(encoding="utf-8")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    text, found = _LIST_OF_PAGES.subn("", readme)
    if not found:
        raise PluginError("README.md has no section 'What is where', in place of which are cards")
    head, mark, rest = text.partition("\n## ")
    return f"---\nhide: [navigation]\n---\n\n{head}\n{cards}{mark}{rest}"


def source_page(path: str) -> str:
    """A file or folder of the repository as a page; one that is code is not searched."""
    file = ROOT / path
    if path == "README.md":
        return relinked(home_page(), ".", place(path))
    if path.endswith((".md", ".ipynb")):
        text = file.read_text(encoding="utf-8")
        text = notebook_text(text) if path.endswith(".ipynb") else text
        return relinked(text, posixpath.dirname(path), place(path))
    title = f"---\nsearch: {{exclude: true}}\n---\n\n# {path}"
    if file.is_dir():
        names = sorted(each.name for each in file.iterdir() if not each.name.startswith(("_", ".")))
        return f"{title}/\n\n" + "".join(f"- `{name}`\n" for name in names)
    language = _LANGUAGES.get(PurePosixPath(path).suffix, "text")
    return f"{title}\n\n````{language}\n{file.read_text(encoding='utf-8')}````\n"


def notebook_text(text: str) -> str:
    """The cells of a notebook as Markdown, with what they printed and drew."""
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        parts.append(f"```python\n{source}\n```" if cell["cell_type"] == "code" else source)
        for output in cell.get("outputs", []):
            picture = output.get("data", {}).get("image/png")
            if picture:
                inline = "".join(picture.split())
                parts.append(f"![What this cell draws](data:image/png;base64,{inline})")
            elif "text" in output:
                parts.append(f"```text\n{''.join(output['text'])}```")
    return "\n\n".join(parts)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the version to the title, and the repository, if it is known, to the foot."""
    package = (ROOT / "torchrl_mpfa" / "__init__.py").read_text(encoding="utf-8")
    (version,) = re.findall(r'^__version__ = "(.+)"', package, re.MULTILINE)
    config.site_name = f"{config.site_name} {version}"
    if address := os.environ.get("REPOSITORY_URL"):
        config.copyright = f'<a href="{html.escape(address)}">Repository</a>'
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the README, the notebook, and what pages link to outside of ``docs/``."""
    wanted = set(_PLACES) | linked_files(home_page(), ".")
    for file in files.documentation_pages():
        wanted |= linked_files(file.content_string, posixpath.join("docs", _folder(file.src_uri)))
    made: set[str] = set()
    while new := sorted(wanted - made):
        for path in new:
            in_nav = path in _PLACES
            page = File.generated(
                config,
                place(path),
                content=source_page(path),
                inclusion=InclusionLevel.INCLUDED if in_nav else InclusionLevel.NOT_IN_NAV,
            )
            files.append(page)
            if path.endswith(".md") and not in_nav:
                text = (ROOT / path).read_text(encoding="utf-8")
                wanted |= linked_files(text, posixpath.dirname(path))
        made |= set(new)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to files outside of ``docs/`` to their pages, and add words for the search.

    The numbers of an interval stay on one line.
    """
    page.meta["tags"] = config.extra["search_words"].get(page.file.src_uri)
    markdown = _ROW.sub(lambda row: _TOGETHER.sub(_unbroken, row[0]), markdown)
    if page.file.generated_by is not None:
        return markdown
    uri = page.file.src_uri
    return relinked(markdown, posixpath.join("docs", _folder(uri)), uri)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn formulas to MathML, and pictures to links."""

    def formula(found: re.Match[str]) -> str:
        text = html.unescape(found[2])
        if found[1] == "span":
            return convert(text, display="inline")
        return f'<div class="formula">{convert(text, display="block")}</div>'

    def picture(found: re.Match[str]) -> str:
        if found[1] or found[2].startswith("data:"):
            return found[0]
        return f'<a class="picture" href="{found[2]}">{found[0]}</a>'

    return _PICTURE.sub(picture, _FORMULA.sub(formula, content))


def _unbroken(found: re.Match[str]) -> str:
    """A space that does not end a line; code as it is."""
    return "\u00a0" if found[0] == " " else found[0]


def _is_on_site(path: str) -> bool:
    """Whether a path of the repository is a file that MkDocs finds by itself."""
    return path.startswith("docs/") and not (ROOT / path).is_dir()


def _folder(uri: str) -> str:
    return posixpath.dirname(uri)
