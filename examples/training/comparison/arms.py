"""The arms of a comparison: named settings of some of its runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from training.settings.command_line import parse_overrides
from training.settings.rules import NAME, named

DEFAULTS = ("tracking=off", "evaluation.every=5000")
"""Settings of a comparison unless its command line has others."""
_OF_THE_COMPARISON = ("learner", "method", "seed", "run_dir", "overwrite", "resume")
"""Settings that a comparison gives each of its runs."""
_COMMA = re.compile(r""",(?![^\[]*\]|[^{]*\}|[^']*'(?:[^']*'[^']*')*[^']*$)""")
"""A comma between two settings: no bracket that was opened before it closes after it, no quote."""


@dataclass(frozen=True)
class Arm:
    """Settings of ``train.py`` that some runs of a comparison have, and a name for them."""

    name: str = ""
    """Part of the name of its runs."""
    settings: tuple[str, ...] = ()
    """As on the command line of ``train.py``."""

    def over(self, overrides: Sequence[str]) -> list[str]:
        """The settings of a comparison with those of the arm in the place of the same ones."""
        # The whole of a group takes the place of each setting in it.
        replaced = tuple(f"{_key(setting)}." for setting in self.settings)
        kept = [text for text in overrides if not f"{_key(text)}.".startswith(replaced)]
        return [*kept, *self.settings]


PLAIN = Arm()
"""The only arm of a comparison for which none is named."""


def parse_arms(texts: Sequence[str]) -> list[Arm]:
    """Parse the arms on a command line; :data:`PLAIN` if there are none."""
    arms: list[Arm] = []
    for text in texts:
        with named(f"--arm {text}: "):
            arm = parse_arm(text)
        if arm.name in [other.name for other in arms]:
            raise ValueError(f"--arm has {arm.name} twice")
        arms.append(arm)
    return arms or [PLAIN]


def parse_arm(text: str) -> Arm:
    """Parse an arm, ``NAME:SETTING=VALUE,SETTING=VALUE``; commas in brackets are of the value.

    Examples:
        >>> parse_arm("short:robots=1,curriculum.stages=[{world: A, actions: 500}]").settings
        ('robots=1', 'curriculum.stages=[{world: A, actions: 500}]')
        >>> parse_arm("default:")
        Arm(name='default', settings=())
    """
    name, colon, listed = text.partition(":")
    allowed, wanted = NAME
    if not colon or not allowed(name):
        raise ValueError(f"must be NAME:SETTING=VALUE,... with a NAME of {wanted}")
    settings = tuple(part.strip() for part in _COMMA.split(listed)) if listed.strip() else ()
    check_free(settings)
    return Arm(name, settings)


def check_free(
    settings: Sequence[str], taken: Sequence[str] = _OF_THE_COMPARISON, *, by: str = "comparison"
) -> None:
    """Raise for settings that a comparison or a search gives its runs itself, and unknown ones."""
    for setting in settings:
        if setting.startswith("-") or "=" not in setting:
            raise ValueError(f"{setting!r} is not NAME=VALUE")
    for override in parse_overrides(settings):
        key = override.key_or_group
        if key in taken:
            raise ValueError(f"{key} is what the {by} gives each run, not a setting of all")


def with_defaults(overrides: Sequence[str]) -> list[str]:
    """The settings of a comparison, but where the command line has others."""
    given = {_key(override) for override in overrides}
    return [*(d for d in DEFAULTS if _key(d) not in given), *overrides]


def _key(setting: str) -> str:
    return setting.partition("=")[0]
