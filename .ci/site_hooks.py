"""What makes one set of pages work in the repository and on the site.

The site's first page is the README. A page may link to any file of the repository: such a file
becomes a page with its text. Formulas become MathML, which browsers show without a script.
"""

from __future__ import annotations

import html
import json
import posixpath
import re
from pathlib import Path, PurePosixPath

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
_LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)(#[^)\s]*)?(?=\))")
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
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
    if path == "README.md":
        return "index.md"
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


def source_page(path: str) -> str:
    """A file or folder of the repository as a page."""
    file = ROOT / path
    if file.is_dir():
        names = sorted(each.name for each in file.iterdir() if not each.name.startswith(("_", ".")))
        return f"# {path}/\n\n" + "".join(f"- `{name}`\n" for name in names)
    text = file.read_text(encoding="utf-8")
    if path.endswith(".ipynb"):
        text = notebook_text(text)
    if path.endswith((".md", ".ipynb")):
        return relinked(text, posixpath.dirname(path), place(path))
    language = _LANGUAGES.get(PurePosixPath(path).suffix, "text")
    return f"# {path}\n\n````{language}\n{text}````\n"


def notebook_text(text: str) -> str:
    """The cells of a notebook as Markdown."""
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        parts.append(f"```python\n{source}\n```" if cell["cell_type"] == "code" else source)
    return "\n\n".join(parts)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the README, and what pages link to outside of ``docs/``."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    wanted = linked_files(readme, ".")
    for file in files.documentation_pages():
        wanted |= linked_files(file.content_string, posixpath.join("docs", _folder(file.src_uri)))
    text = relinked(readme, ".", "index.md")
    files.append(File.generated(config, "index.md", content=text))
    made = {"README.md"}
    while new := sorted(wanted - made):
        for path in new:
            page = File.generated(
                config,
                place(path),
                content=source_page(path),
                inclusion=InclusionLevel.NOT_IN_NAV,
            )
            files.append(page)
            if path.endswith(".md"):
                text = (ROOT / path).read_text(encoding="utf-8")
                wanted |= linked_files(text, posixpath.dirname(path))
        made |= set(new)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to files outside of ``docs/`` to their pages."""
    if page.file.generated_by is not None:
        return markdown
    uri = page.file.src_uri
    return relinked(markdown, posixpath.join("docs", _folder(uri)), uri)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn formulas to MathML."""

    def formula(found: re.Match[str]) -> str:
        display = "block" if found[1] == "div" else "inline"
        return convert(html.unescape(found[2]), display=display)

    return _FORMULA.sub(formula, content)


def _is_on_site(path: str) -> bool:
    """Whether a path of the repository is a file that MkDocs finds by itself."""
    return path.startswith("docs/") and not (ROOT / path).is_dir()


def _folder(uri: str) -> str:
    return posixpath.dirname(uri)
