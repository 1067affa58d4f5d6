"""The command line of ``train.py``, its file of settings, and its help.

Each error is one sentence, raised before anything starts.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from itertools import pairwise, product
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from mpfa_envs.robots.resolve import resolve_robot
from torchrl_mpfa.methods import METHODS, Method
from torchrl_mpfa.methods.catalogue import RECONSTRUCTED, unknown_method
from training.plugins import with_plugin
from training.settings.rules import named, settings_by_name
from training.settings.train import GROUPS, SEVERAL, TrainSettings, as_settings, register

_WITH_A_WORD = ("--cfg", "-c", "--package", "-p", "--info", "-i")
"""Options of Hydra that are followed by a word of their own."""


@cache
def known_settings() -> tuple[str, ...]:
    """Return the dotted names of all settings, of all methods, and of their sections."""
    names: dict[str, None] = {}
    for method in METHODS.values():
        for name, _ in settings_by_name(TrainSettings(method=method)):
            section, _, _ = name.rpartition(".")
            names |= dict.fromkeys((section.partition(".")[0], section, name))
    return tuple(filter(None, names))


def parse_overrides(arguments: Sequence[str]) -> list[Override]:
    """Parse the settings on a command line, those of its file first."""
    file, lines = lines_of(arguments)
    texts = [
        text
        for before, text in pairwise(["", *arguments])
        if not text.startswith("-") and before not in _WITH_A_WORD and text != f"settings={file}"
    ]
    with named(f"{file}: "):
        of_file = _parsed(lines)
    return [*of_file, *_parsed(texts)]


def _parsed(texts: Sequence[str]) -> list[Override]:
    """Parse settings; raise for unknown names and choices."""
    parser = OverridesParser.create()
    parsed = []
    for text in texts:
        try:
            parsed.append(parser.parse_override(quoted(text)))
        except HydraException as error:
            # Where the grammar's own error has no text, Hydra's has.
            reason = str(error).splitlines()[0]
            raise ValueError(
                f"{text!r} is not NAME=VALUE: {reason}: put a value that has brackets or commas in "
                f"""quotes, as in "NAME='VALUE'\""""
            ) from error
    known = known_settings()
    overrides = [each for each in parsed if not each.key_or_group.startswith("hydra")]
    for override in overrides:
        key = override.key_or_group
        if key not in known:
            raise ValueError(f"unknown setting {key!r}{_nearest(key, known)}")
        if key in GROUPS and not override.is_sweep_override():
            _check_choices(key, choices_of(override))
    return overrides


def _check_choices(group: str, words: Sequence[str]) -> None:
    """Raise for unknown choices of a group, and choices that exclude each other."""
    for word in words:
        if group == "method" and word in RECONSTRUCTED and word not in METHODS:
            raise ValueError(unknown_method(word))
        if word not in GROUPS[group]:
            raise ValueError(
                f"unknown choice {word!r} of {group!r}{_nearest(word, GROUPS[group])}; "
                f"there are: {', '.join(GROUPS[group])}"
            )
    given = ",".join(words)
    if group != SEVERAL and len(words) != 1:
        raise ValueError(f"{group} must be one of {', '.join(GROUPS[group])}, got [{given}]")
    if group != SEVERAL:
        return
    keys = [key for word in words for key in GROUPS[group][word]]
    if not words or len(keys) < len(words) > 1 or len(set(keys)) < len(keys):
        raise ValueError(
            f"{group} must be off, or one or several of wandb (or online), tensorboard and csv, "
            f"got [{given}]"
        )


def choices_of(override: Override) -> list[str]:
    """Return the choices of a group on a command line: one, or several in brackets."""
    value = override.value()
    return [str(word) for word in (value if isinstance(value, list) else [value])]


def composed(arguments: Sequence[str]) -> Iterator[TrainSettings]:
    """Yield the settings of each run of a command line, checked."""
    for settings in read_settings(arguments):
        # Imports TorchRL, which takes two seconds: what is misspelt is answered before.
        from training.settings.checks import check_settings

        check_settings(settings)
        yield settings


def read_settings(arguments: Sequence[str]) -> Iterator[TrainSettings]:
    """Yield the settings of each run of a command line; names and types are checked."""
    alternatives = []
    for override in parse_overrides(arguments):
        text = override.input_line or ""
        if override.is_sweep_override():
            key = text.partition("=")[0]
            alternatives.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        else:
            alternatives.append([text])
    for texts in product(*alternatives):
        try:
            # Of a module, as Hydra would read the source of every caller to find out where it is.
            with initialize_config_module("training.settings", version_base="1.3"):
                settings = as_settings(compose("train", list(texts)))
        except (HydraException, OmegaConfBaseException) as error:
            raise ValueError(_one_line(error)) from error
        with named("environment."):
            resolve_robot(settings.environment.robot)
        yield settings


def _one_line(error: Exception) -> str:
    """Return the cause of an error of OmegaConf or Hydra in one line."""
    cause: BaseException = error
    while cause.__cause__ is not None:
        cause = cause.__cause__
    key = getattr(cause, "full_key", None)
    kind = getattr(cause, "object_type", None)
    if isinstance(cause, AttributeError | KeyError) and is_dataclass(kind):
        names = [each.name for each in fields(kind)]
        if isinstance(kind, type) and issubclass(kind, Method):
            return f"this method has no {key}, but {', '.join(names)}"
        word = str(key).rpartition(".")[2]
        hint = _nearest(word, names) or f", but {', '.join(names)}"
        return f"{getattr(kind, '__name__', kind)} has no {word!r}{hint}"
    text = str(getattr(cause, "msg", None) or cause).splitlines()[0]
    return f"{key}: {text}" if key else text


def _nearest(word: str, known: Iterable[str]) -> str:
    """Suggest the nearest known name."""
    # Most mistakes are typos, or settings without the section they are in.
    names = list(known)
    section, _, last = word.rpartition(".")
    beside = {n.rpartition(".")[2]: n for n in names if section and n.rpartition(".")[0] == section}
    if in_section := difflib.get_close_matches(last, beside, n=1):
        return f": did you mean {beside[in_section[0]]!r}?"
    near = difflib.get_close_matches(word, names, n=1, cutoff=0.5)
    inside = [name for name in names if name.split(".")[-1] == word.split(".")[-1]]
    typo = difflib.get_close_matches(word, [n for n in names if "." not in n], n=1, cutoff=0.8)
    found = dict.fromkeys([*typo, *inside[:1]] or near)
    return f": did you mean {' or '.join(map(repr, found))}?" if found else ""


_FILE = "settings="
_QUOTED = r"""'(?:\\.|[^'])*'|"(?:\\.|[^"])*\""""
_SPECIAL = r"[^\x00-\x7f]|[#!&;<>^`~]"
"""Characters that Hydra reads in quotes only."""


def lines_of(arguments: Sequence[str]) -> tuple[str, list[str]]:
    """Return the file of settings of a command line, empty without one, and its settings.

    Settings that the command line has are left out.
    """
    files = [text.removeprefix(_FILE) for text in arguments if text.startswith(_FILE)]
    if len(files) > 1:
        raise ValueError(f"settings must be one file, got {' and '.join(files)}")
    if not files:
        return "", []
    given = {text.partition("=")[0] for text in arguments}
    found = read_names(Path(files[0]))
    return files[0], [f"{n}={as_text(value)}" for n, value in found.items() if n not in given]


def with_lines(arguments: Sequence[str]) -> list[str]:
    """Return a command line for Hydra: a file of settings is replaced by its settings."""
    _, lines = lines_of(arguments)
    words = [word for text in arguments for word in (lines if text.startswith(_FILE) else [text])]
    return [quoted(word) for word in words]


def quoted(text: str) -> str:
    """Put the words of a setting in quotes if Hydra cannot read them without.

    Examples:
        >>> quoted("run_dir=/runs/ünï"), quoted("seed=1"), quoted("names=[a,ü,'ï']")
        ("run_dir='/runs/ünï'", 'seed=1', "names=[a,'ü','ï']")
    """
    name, equals, value = text.partition("=")
    if not equals or text.startswith("-"):
        return text
    # A colon ends a key of a mapping, and is part of a word elsewhere.
    word = rf"(?:[^,\[\]{{}}()'\"{':' if '{' in value else ''}])+"

    def in_quotes(found: re.Match[str]) -> str:
        part = found.group()
        return f"'{part}'" if part[0] not in "'\"" and re.search(_SPECIAL, part) else part

    return name + equals + re.sub(f"{_QUOTED}|{word}", in_quotes, value)


def read_names(path: Path) -> dict[str, Any]:
    """Read a YAML file whose keys are the dotted names of settings."""
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    try:
        found = OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, YAMLError, OmegaConfBaseException, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}") from error
    if not isinstance(found, dict) or not found:
        raise ValueError(f"{path} must have a line NAME: VALUE for each setting")
    return {str(name): value for name, value in found.items()}


def as_text(value: Any) -> str:
    """Write a value as on the command line.

    Examples:
        >>> as_text([{"world": "A", "actions": 500}]), as_text(None), as_text(1e-4)
        ('[{world:A,actions:500}]', 'null', '0.0001')
    """
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_text, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{name}:{as_text(each)}" for name, each in value.items()) + "}"
    return str(value)


_HELP = """{usage}
The choices of each group, GROUP=CHOICE:

{groups}

Every setting with its value, NAME=VALUE:

{settings}
Options of Hydra, as --multirun and --cfg: --hydra-help"""


def help_text(usage: str, arguments: Sequence[str] = ()) -> str:
    """Return usage, the choices of each group, and every setting with its value."""
    arguments, _ = with_plugin(arguments)
    register()
    given = [text for text in with_lines(arguments) if not text.startswith("-")]
    try:
        with initialize_config_module("training.settings", version_base="1.3"):
            settings = compose("train", given)
    except HydraException as error:
        raise ValueError(str(error).splitlines()[0]) from error
    groups = (f"{group}: {', '.join(sorted(choices))}" for group, choices in GROUPS.items())
    return _HELP.format(usage=usage, groups="\n".join(groups), settings=OmegaConf.to_yaml(settings))
