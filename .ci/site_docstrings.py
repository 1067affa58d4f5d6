"""Docstrings and values as the site needs them: Markdown, and defaults without their code."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable
from typing import Any

from griffe import Attribute, Expr, ExprCall, ExprKeyword, Extension, NameResolutionError, Object

# "in [-π, π] [rad]" would be a link to "rad".
_UNIT = re.compile(r"(?<=\]) \[(?=[a-zA-Z/²]+\])")
_ROLE = re.compile(r":(?:class|func|meth|attr|data|mod|exc|obj):`(~?)([\w.]+)`")
_MATH = re.compile(r":math:`([^`]+)`")
_FORMULA = re.compile(r"^( *)\.\. math::(.*\n(?:\n|\1 +.*\n?)*)", re.MULTILINE)
_TABLE = re.compile(
    r"^( *)(=+(?: +=+)+)\n((?:\1(?!=).*\n)+)(?:\1=[= ]+\n((?:\1(?!=).*\n)+))?\1=[= ]+$", re.M
)

_LONGEST = 60
_CALL = re.compile(r"\w\(")


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


class Defaults(Extension):
    """Shows a value that says something to a reader: a default or a short constant, not code."""

    def on_attribute_instance(self, *, attr: Attribute, **kwargs: Any) -> None:
        """Replace a field by its default, before signatures are made of fields."""
        if isinstance(field := attr.value, ExprCall) and str(field.function) in _DEFAULT:
            attr.value = _DEFAULT[str(field.function)](field)

    def on_attribute(self, *, attr: Attribute, **kwargs: Any) -> None:
        """Leave out a value that is code."""
        code = str(attr.value)
        if len(code) > _LONGEST or _CALL.search(code) or code == attr.name:
            attr.value = None


def _default_of_field(field: ExprCall) -> str | Expr:
    """The default of a dataclass's field, without its other options, if it has one."""
    options = [each for each in field.arguments if isinstance(each, ExprKeyword)]
    return next((each.value for each in options if each.name == "default"), field)


_DEFAULT: dict[str, Callable[[ExprCall], str | Expr]] = {
    "field": _default_of_field,
    "within": lambda field: field.arguments[1],
    "one_of": lambda field: field.arguments[0],
}


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
