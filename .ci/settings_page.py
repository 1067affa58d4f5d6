"""Write the tables of ``docs/reference/settings.md`` from the settings of ``train.py``.

    python .ci/settings_page.py

Run it after a change of a setting, its default or its docstring; a test compares the page with it.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module

from torchrl_mpfa.methods import METHODS
from training.settings.rules import settings_by_name
from training.settings.train import GROUPS, Stage, TrainSettings, as_settings, register

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "settings.md"
START = "## All settings\n"
REGIMES = ("rooms", "paper")


def page() -> str:
    """The page with new tables below its introduction."""
    register()
    introduction = PAGE.read_text(encoding="utf-8").partition(START)[0]
    learners = "".join(_learner_row(name) for name in GROUPS["learner"])
    return (
        f"{introduction}{START}\n| setting | default | meaning |\n|---|---|---|\n{''.join(_rows())}"
        "\n## Learners\n\n"
        "What `learner=NAME` sets other than `learner=ddpg`; `regime=rooms` wins over it.\n"
        f"\n| learner | settings | meaning |\n|---|---|---|\n{learners}"
        "\n## Methods\n\nWhat a method has beyond `method=mpfa_per`, or with another default.\n"
        f"\n| setting | default | meaning, if not above |\n|---|---|---|\n{_method_rows()}"
    )


def _rows() -> Iterator[str]:
    """A row for each setting, and for each field of a stage."""
    meanings = dict(_meanings(TrainSettings, ""))
    values = [_values(regime) for regime in REGIMES]
    for name, meaning in meanings.items():
        rooms, paper = (_shown(each[name]) for each in values)
        yield _row(name, _of_regimes(rooms, paper), meaning)
        if name == "curriculum.stages":
            for field, of_a_stage in _meanings(Stage, ""):
                default = _shown(getattr(Stage(), field))
                yield _row(f"{name}[].{field}", default, of_a_stage)


def _learner_row(learner: str) -> str:
    changed = []
    for regime in REGIMES:
        usual, values = _values(regime), _values(regime, f"learner={learner}")
        changed.append(
            " ".join(
                f"`{name.partition('.')[2]}={_shown(value)[1:]}"
                for name, value in values.items()
                if name.startswith("learner.") and value != usual[name]
                if name not in ("learner.name", "learner.algorithm")
            )
        )
    meaning = _text(GROUPS["learner"][learner].__doc__)
    return f"| `{learner}` | {_of_regimes(*changed)} | {meaning} |\n"


def _of_regimes(rooms: str, paper: str) -> str:
    """What holds in both regimes, or in each."""
    if rooms == paper:
        return rooms
    return "<br>".join(
        f"{name}: {value}" for name, value in zip(REGIMES, (rooms, paper), strict=True) if value
    )


def _method_rows() -> str:
    """A row for each setting that a method has other than ``mpfa_per``, or with another default."""
    usual = METHODS["mpfa_per"]
    above = {entry.name for entry in fields(usual)}
    rows: dict[str, dict[str, list[str]]] = {}
    own: dict[str, str] = {}
    for method, made in METHODS.items():
        meanings = dict(_meanings(type(made), ""))
        for entry in fields(made):
            value = getattr(made, entry.name)
            if entry.name != "name" and getattr(usual, entry.name, None) != value:
                rows.setdefault(entry.name, {}).setdefault(_shown(value), []).append(f"`{method}`")
                own[entry.name] = "" if entry.name in above else meanings[entry.name]
    return "".join(
        _row(
            f"method.{name}",
            "<br>".join(f"{value}: {', '.join(found)}" for value, found in values.items()),
            own[name],
        )
        for name, values in sorted(rows.items())
    )


@cache
def _values(regime: str, *overrides: str) -> dict[str, Any]:
    """Every setting of a run that names a regime alone, and the choices of the groups."""
    with initialize_config_module("training.settings", version_base="1.3"):
        config = compose("train", [f"regime={regime}", *overrides], return_hydra_config=True)
    chosen = config.hydra.runtime.choices
    settings = as_settings(config)
    return dict(settings_by_name(settings)) | {name: chosen[name] for name in GROUPS}


def _meanings(settings: Any, prefix: str) -> Iterator[tuple[str, str]]:
    """Names and docstrings of the fields of settings, those of a group after its own."""
    documented = {}
    for kind in settings.__mro__[-2::-1]:
        tree = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
        assert isinstance(tree, ast.ClassDef)
        for field, text in zip(tree.body, tree.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                documented[ast.unparse(field.target)] = _text(ast.literal_eval(text.value))
    for entry in fields(settings):
        name = prefix + entry.name
        if name in ("hydra", "defaults"):
            continue
        group = entry.default_factory if callable(entry.default_factory) else None
        if not is_dataclass(group) or name in GROUPS:
            yield name, documented[entry.name]
        if is_dataclass(group):
            yield from _meanings(group, f"{name}.")


def _row(name: str, *cells: str) -> str:
    return f"| `{name}` | {' | '.join(cells)} |\n"


def _shown(value: Any) -> str:
    """A value as on a command line."""
    return f"`{_plain(value)}`"


def _plain(value: Any) -> str:
    if isinstance(value, Stage):
        given = {f.name: getattr(value, f.name) for f in fields(value)}
        return "{" + ", ".join(f"{name}: {each}" for name, each in given.items() if each) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(_plain, value))}]"
    return value if isinstance(value, str) else json.dumps(value)


def _text(docstring: str | None) -> str:
    """A docstring as a cell of a table."""
    text = " ".join((docstring or "").split())
    text = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", text).replace("``", "`")
    return text.replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
