"""Which settings a search may change, and between which values: a file, checked at the start."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_mpfa.spelling import unknown
from training.comparison.arms import with_defaults
from training.settings.command_line import composed, parse_overrides
from training.settings.from_file import as_text, read_names
from training.settings.rules import settings_by_name
from training.settings.train import TrainSettings
from training.worlds import is_of_a_test

if TYPE_CHECKING:
    from optuna import Trial

Value = str | int | float | bool | None
OF_THE_SEARCH = ("seed", "run_dir", "overwrite", "resume", "checkpoint_every")
"""Settings that a search gives each of its runs."""
_ALIKE = ("evaluation", "curriculum", "regime", "tracking", "ray", "device", "threads")
"""What the trials of a search have in common: how they are compared, and where they run."""


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``, both included; integers if both are."""

    low: float
    high: float
    log: bool = False
    """Whether their logarithms are searched evenly."""

    @property
    def ends(self) -> tuple[Value, ...]:
        """What is tried before the search: if these are allowed, so is what is between them."""
        return self.low, self.high

    def suggest(self, trial: Trial, name: str) -> Value:
        """A value for a trial."""
        if isinstance(self.low, int) and isinstance(self.high, int):
            return trial.suggest_int(name, self.low, self.high, log=self.log)
        return trial.suggest_float(name, self.low, self.high, log=self.log)


@dataclass(frozen=True)
class Choice:
    """One of some values."""

    values: tuple[Value, ...]

    @property
    def ends(self) -> tuple[Value, ...]:
        """All of them."""
        return self.values

    def suggest(self, trial: Trial, name: str) -> Value:
        """A value for a trial."""
        return trial.suggest_categorical(name, self.values)


Ranges = Mapping[str, Range | Choice]


def fixed_settings(settings: Sequence[str]) -> TrainSettings:
    """The settings that all trials have, with the defaults of a search.

    Args:
        settings: As on the command line of ``train.py``.

    Raises:
        ValueError: If a run cannot have them, or a search cannot go by its evaluations.
    """
    for text in settings:
        if text.startswith("-") or "=" not in text:
            raise ValueError(f"{text!r} is not NAME=VALUE")
    for override in parse_overrides(settings):
        if override.key_or_group in OF_THE_SEARCH:
            raise ValueError(f"{override.key_or_group} is what the search gives each run")
    first, *others = composed(with_defaults(settings))
    if others:
        raise ValueError("a search takes one value for each setting, ranges are in its file")
    if is_of_a_test(first.evaluation.world):
        raise ValueError(
            f"evaluation.world must not be of a test, got {first.evaluation.world}: nothing may be "
            "chosen there"
        )
    most = sum(stage.actions for stage in first.curriculum.stages)
    every = first.evaluation.every
    if every == 0 or 0 < most < every:
        raise ValueError(
            f"evaluation.every must be from 1 to the {most or 'many'} actions of a run, got {every}"
        )
    return first


def read_ranges(path: Path, settings: Sequence[str]) -> Ranges:
    """The ranges in a file.

    Args:
        path: YAML with a line for each setting, ``NAME: {low: 1.0e-4, high: 1.0e-2, log: true}`` or
            ``NAME: [VALUE, VALUE]``.
        settings: What all trials have, as on the command line of ``train.py``.

    Raises:
        ValueError: If there is no such setting, if it is given to all trials, or if a run cannot
            have a value of its range.
    """
    fixed = dict(settings_by_name(fixed_settings(settings)))
    given = {override.key_or_group for override in parse_overrides(settings)}
    written = read_names(path)
    try:
        ranges = {name: _range(name, each, fixed) for name, each in written.items()}
        for name in ranges:
            if name in given:
                raise ValueError(f"{name} is given to all trials: leave it out here or there")
        for ends in _corners(ranges):
            list(composed([*settings, *as_lines(ends)]))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return ranges


def as_lines(values: Mapping[str, Value]) -> list[str]:
    """Settings as on the command line of ``train.py``."""
    return [f"{name}={as_text(value)}" for name, value in values.items()]


def _corners(ranges: Ranges) -> Iterator[dict[str, Value]]:
    """The first value of every range together, then the second of each, and so on."""
    for number in range(max(len(each.ends) for each in ranges.values())):
        yield {name: each.ends[min(number, len(each.ends) - 1)] for name, each in ranges.items()}


def _range(name: str, written: Any, fixed: Mapping[str, Any]) -> Range | Choice:
    """The range of a setting, from what the file has for it."""
    texts = [as_text(each) for each in written] if isinstance(written, list) else []
    # It says which setting may have been meant, and which choices a group has.
    overrides = parse_overrides([f"{name}={text}" for text in texts or ["null"]])
    if name in OF_THE_SEARCH or name.split(".")[0] in _ALIKE:
        raise ValueError(f"{name} cannot be searched: it must be the same in all trials")
    if isinstance(written, dict) and _is_number(fixed.get(name)):
        return _numbers(name, written, whole=isinstance(fixed[name], int))
    if len(texts) < 2 or len(set(texts)) < len(texts):
        number = " or {low: NUMBER, high: NUMBER}" * _is_number(fixed.get(name))
        raise ValueError(
            f"{name} must be [VALUE, VALUE, ...], each once,{number} got {as_text(written)}"
        )
    if any(override.is_sweep_override() for override in overrides):
        raise ValueError(f"{name} must have single values, got {as_text(written)}")
    # Optuna keeps words and numbers; what else there is becomes one as on the command line.
    return Choice(
        tuple(each if each is None or _is_number(each) else as_text(each) for each in written)
    )


def _numbers(name: str, written: Mapping[Any, Any], *, whole: bool) -> Range:
    """A range of numbers, whole ones if the setting is one."""
    for word in written:
        if word not in ("low", "high", "log"):
            raise ValueError(f"{name}: {unknown('word', word, ['low', 'high', 'log'])}")
    ends: list[Any] = [written.get("low"), written.get("high")]
    (low, high), log = ends, written.get("log", False)
    kind = "whole numbers" if whole else "numbers"
    right = [_is_number(end) and (isinstance(end, int) or not whole) for end in ends]
    if not all(right) or not low < high:
        raise ValueError(f"{name} must have {kind} low < high, got low={low}, high={high}")
    if not isinstance(log, bool) or (log and low <= 0):
        raise ValueError(f"{name}: log must be true, with low above 0, or false, got {log}")
    return Range(low, high, log) if whole else Range(float(low), float(high), log)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
