"""Docstrings as the site needs them: roles, ``:class:`~package.Name```, become links."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, NameResolutionError, Object

# "in [-π, π] [rad]" would be a link to "rad".
_UNIT = re.compile(r"(?<=\]) \[(?=[a-zA-Z/²]+\])")
_ROLE = re.compile(r":(?:class|func|meth|attr|data|mod|exc|obj):`(~?)([\w.]+)`")


class LinkRoles(Extension):
    """Turns every role of a docstring to a link, where the site has what it names."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Rewrite the docstring of one object."""
        if obj.docstring is not None:
            text = _UNIT.sub(r" \\[", obj.docstring.value)
            obj.docstring.value = _ROLE.sub(lambda role: _link(role, obj), text)


def _link(role: re.Match[str], where: Object) -> str:
    name = role[2]
    try:
        path = where.resolve(name)
    except NameResolutionError:
        path = name
    shown = name.rpartition(".")[2] if role[1] else name
    return f'<autoref optional identifier="{path}"><code>{shown}</code></autoref>'
