"""SDF files: their elements, with lines, and the models that they include from search folders."""

from __future__ import annotations

import gzip
import io
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final
from xml.parsers import expat

from mpfa_envs.files import cause_of, read_file
from mpfa_envs.worlds.yaml_nodes import WorldFileError, read_number

LARGEST_FILE: Final = 20_000_000
"""Longest text that is read [bytes]."""
_DEEPEST: Final = 100
"""Greatest depth of nested elements."""
_MOST_ELEMENTS: Final = 500_000
"""Most elements of a file with all that it includes."""
_MARKS: Final = re.compile(
    rb"<!--.*?(?:-->|\Z)|<!\[CDATA\[.*?(?:\]\]>|\Z)|<\?.*?(?:\?>|\Z)", re.DOTALL
)
"""Comments, quoted text and declarations; one without an end is tried once."""
_AMPERSAND: Final = re.compile(rb"&(?!(?:amp|lt|gt|quot|apos|#\d+|#x[\da-fA-F]+);)")
"""An ampersand that begins no character."""
_STAGE: Final = re.compile(rb"^\s*(?:define\s+\w+\s+)?\w+\s*\(", re.MULTILINE)
"""A part of a world of Stage, whose files have the same ending."""
_OF_STAGE: Final = (
    "is a world of Stage, not of Gazebo: give its bitmap as a ROS map, a .yaml file with the keys "
    "image, resolution, origin, negate, occupied_thresh and free_thresh"
)
_JUNK: Final = expat.errors.codes[expat.errors.XML_ERROR_JUNK_AFTER_DOC_ELEMENT]


@dataclass(slots=True)
class Element:
    """An element of a file, with its line."""

    path: str
    tag: str
    attributes: dict[str, str]
    line: int
    pieces: list[str] = field(default_factory=list)
    children: list[Element] = field(default_factory=list)

    @property
    def text(self) -> str:
        """Text between its children."""
        return "".join(self.pieces).strip()

    def all(self, tag: str) -> Iterator[Element]:
        """Its children with a tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> Element | None:
        """Its first child with a tag; None without one."""
        return next(self.all(tag), None)

    def count(self, tag: str) -> int:
        """Count the elements with a tag in it, itself included."""
        return (self.tag == tag) + sum(child.count(tag) for child in self.children)

    def error(self, text: str) -> WorldFileError:
        """An error at its line."""
        return WorldFileError(f"{self.path}:{self.line}: {text}")


class SdfFiles:
    """Parses a file and those that it includes, which must lie in one of some folders."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = [folder.resolve() for folder in folders]
        self._elements = 0
        self._models: dict[Path, tuple[Element | None, int]] = {}

    def parse(self, path: str, text: bytes) -> Element:
        """Read the elements; a document type, which could define entities, is rejected."""
        parser = expat.ParserCreate(_older_encoding(text))
        parser.buffer_text = True  # Else each line end is a separate piece.
        document = Element(path, "", {}, 1)
        open_ones = [document]

        def error(reason: str) -> WorldFileError:
            return WorldFileError(f"{path}:{parser.CurrentLineNumber}: {reason}")

        def start(tag: str, attributes: dict[str, str]) -> None:
            element = Element(path, tag, attributes, parser.CurrentLineNumber)
            open_ones[-1].children.append(element)
            open_ones.append(element)
            if len(open_ones) > _DEEPEST:
                raise error("is nested too deeply")
            self._spend(element, 1)

        def end(_: str) -> None:
            open_ones.pop()

        def add(text: str) -> None:
            open_ones[-1].pieces.append(text)

        def reject(*_: object) -> None:
            raise error("must not have a document type, as that may define entities")

        parser.StartElementHandler, parser.EndElementHandler = start, end
        parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = add, reject
        try:
            parser.Parse(_strict(text), True)
        except WorldFileError:
            raise
        except (expat.ExpatError, LookupError, ValueError) as reason:  # The last two: its encoding.
            if getattr(reason, "code", None) != _JUNK:
                stage = b"<" not in text and _STAGE.search(text)
                what = _OF_STAGE if stage else f"is not XML: {reason}"
                raise error(what) from reason
        return document.children[0]

    def included(self, include: Element) -> Element | None:
        """Read the model of an include, with what the include changes; None if there is none."""
        self._spend(include, 100)  # A look into the folders takes as long as a hundred elements.
        uri = include.first("uri")
        path = None if uri is None else self._locate(uri.text)
        if path is None:
            return None
        if path in self._models:
            self._spend(include, self._models[path][1])
        else:
            before = self._elements
            root = self.parse(str(path), read_sdf(path))
            model = root.first("model") if root.tag == "sdf" else None
            self._models[path] = model, self._elements - before
        model = self._models[path][0]
        if model is None:
            return None
        own = {child.tag: child for child in include.children}
        attributes = dict(model.attributes)
        attributes |= {tag: own[tag].text for tag in ("name", "placement_frame") if tag in own}
        changes = [own[tag] for tag in ("pose", "static") if tag in own]
        return replace(model, attributes=attributes, children=[*changes, *model.children])

    def _spend(self, element: Element, count: int) -> None:
        """Count elements that are read, or read once more."""
        self._elements += count
        if self._elements > _MOST_ELEMENTS:
            raise element.error(
                f"has more than {_MOST_ELEMENTS} elements with all that is included"
            )

    def _locate(self, uri: str) -> Path | None:
        """Find the file of a model in a search folder; None for one elsewhere."""
        scheme, _, name = uri.rpartition("://")
        if scheme not in ("model", "file", "") or not name:
            return None
        for folder in self._folders:
            try:
                place = _inside(folder, name)
                if place is not None and place.is_dir():
                    config = _inside(folder, str(place / "model.config"))
                    sdf = "model.sdf" if config is None else self._newest(config)
                    place = _inside(folder, str(place / sdf))
                if place is not None and place.is_file():
                    return place
            except (OSError, RuntimeError):  # A name that is too long, or links in a circle.
                continue
        return None

    def _newest(self, config: Path) -> str:
        """Name the file of the newest version in a ``model.config``."""
        files = self.parse(str(config), read_sdf(config)).all("sdf")
        versions = {read_number(each.attributes.get("version", "0")): each.text for each in files}
        return versions[max(versions)] if versions else "model.sdf"


def read_sdf(path: Path) -> bytes:
    """Read a file, decompressed if it ends in .gz, up to the largest size."""
    try:
        content = read_file(path, LARGEST_FILE)
        if path.suffix.lower() == ".gz":
            content = gzip.GzipFile(fileobj=io.BytesIO(content)).read(LARGEST_FILE + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise WorldFileError(f"{path}: cannot be read: {cause_of(error)}") from error
    if len(content) > LARGEST_FILE:
        raise WorldFileError(f"{path}: has more than {LARGEST_FILE} bytes")
    return content


def _inside(folder: Path, name: str) -> Path | None:
    """Resolve a name in a folder; None if nothing is there, or it leads out of the folder."""
    place = (folder / name).resolve()
    return place if place.is_relative_to(folder) and place.exists() else None


def _older_encoding(text: bytes) -> str | None:
    """Name the encoding of a file that is neither UTF-8 nor UTF-16; None if it says it itself."""
    try:
        text.decode()
    except UnicodeDecodeError:
        return None if b"\0" in text[:4] else "iso-8859-1"
    return None


def _strict(text: bytes) -> bytes:
    """Rewrite what TinyXML2 takes and Expat does not, without moving a line."""
    if b"\0" in text[:4]:  # UTF-16.
        return text
    declarations: list[bytes] = []

    def blank(mark: re.Match[bytes]) -> bytes:
        found = mark[0]
        if found.startswith(b"<![") or not found.endswith((b"-->", b"?>")):
            return found
        if re.match(rb"<\?xml\s", found):
            declarations.append(b" ".join(found.split()))
        return b"\n" * found.count(b"\n")

    text = _AMPERSAND.sub(b"&amp;", _MARKS.sub(blank, text))
    begins = max(text.find(b"<"), 0)
    return b"".join((*declarations[:1], b"\n" * text.count(b"\n", 0, begins), text[begins:]))
