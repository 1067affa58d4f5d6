"""Docstrings as the site needs them: links, formulas and tables of Sphinx become Markdown."""

from __future__ import annotations

import re
import textwrap
from typing import Any

from griffe import Extension, NameResolutionError, Object

# "in [-π, π] [rad]" would be a link to "rad".
_UNIT = re.compile(r"(?<=\]) \[(?=[a-zA-Z/²]+\])")
_ROLE = re.compile(r":(?:class|func|meth|attr|data|mod|exc|obj):`(~?)([\w.]+)`")
_MATH = re.compile(r":math:`([^`]+)`")
_FORMULA = re.compile(r"^( *)\.\. math::(.*\n(?:\n|\1 +.*\n?)*)", re.MULTILINE)
_TABLE = re.compile(
    r"^( *)(=+(?: +=+)+)\n((?:\1(?!=).*\n)+)(?:\1=[= ]+\n((?:\1(?!=).*\n)+))?\1=[= ]+$", re.M
)


class LinkRoles(Extension):
    """Turns roles, formulas and tables of every docstring to Markdown."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Rewrite the docstring of one object."""
        if obj.docstring is not None:
            text = _TABLE.sub(_table, obj.docstring.value)
            text = _FORMULA.sub(_formula, _MATH.sub(r"$\1$", text))
            text = re.sub(r"::$", ":", text, flags=re.MULTILINE)
            text = _UNIT.sub(r" \\[", text)
            obj.docstring.value = _ROLE.sub(lambda role: _link(role, obj), text)


def _link(role: re.Match[str], where: Object) -> str:
    name = role[2]
    try:
        path = where.resolve(name)
    except NameResolutionError:
        path = name
    shown = name.rpartition(".")[2] if role[1] else name
    return f'<autoref optional identifier="{path}"><code>{shown}</code></autoref>'


def _formula(found: re.Match[str]) -> str:
    """A displayed formula, with the indentation of its directive."""
    formula = " ".join(textwrap.dedent(found[2]).split())
    return f"{found[1]}$${formula}$$\n\n"


def _table(found: re.Match[str]) -> str:
    """A table; a line without a first or a second cell goes on with the row before."""
    indent, rule, first, rest = found.groups()
    starts = [mark.start() for mark in re.finditer("=+", rule)]
    rows: list[list[str]] = []
    for line in (first + (rest or "")).splitlines():
        text = line[len(indent) :]
        ends = [*starts[1:], len(text)]
        cells = [text[i:j].strip() for i, j in zip(starts, ends, strict=True)]
        if rows and not (cells[0] and cells[1]):
            rows[-1] = [f"{a} {b}".strip() for a, b in zip(rows[-1], cells, strict=True)]
        else:
            rows.append(cells)
    if rest is None:
        rows.insert(0, [""] * len(starts))
    rows.insert(1, ["---"] * len(starts))
    return "\n".join(f"{indent}| {' | '.join(row)} |" for row in rows)
