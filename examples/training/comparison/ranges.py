"""The ranges of a search, read from a file as Optuna's distributions and checked at the start."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from torchrl_mpfa.checks import unknown
from training.comparison.arms import check_free, with_defaults
from training.settings.command_line import as_text, composed, parse_overrides, read_names
from training.settings.rules import named, settings_by_name
from training.settings.train import TrainSettings
from training.worlds import is_of_a_test

OF_THE_SEARCH = ("seed", "run_dir", "overwrite", "resume", "checkpoint_every")
"""Settings that a search gives each of its runs."""
_ALIKE = (
    "actions",
    "plugin",
    "evaluation",
    "curriculum",
    "regime",
    "tracking",
    "device",
    "threads",
)
"""Groups that are the same in all trials: how trials are compared, and where they run."""


Ranges = Mapping[str, BaseDistribution]
"""Optuna's distribution of each setting."""


def fixed_settings(settings: Sequence[str]) -> TrainSettings:
    """Return the settings of all trials, checked, with the defaults of a search."""
    check_free(settings, OF_THE_SEARCH, by="search")
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
    """Read ranges from a YAML file, which must be possible with the settings of all trials.

    A line is ``NAME: {low: 1.0e-4, high: 1.0e-2, log: true}`` or ``NAME: [VALUE, VALUE]``.
    """
    fixed = dict(settings_by_name(fixed_settings(settings)))
    given = {override.key_or_group for override in parse_overrides(settings)}
    written = read_names(path)
    with named(f"{path}: "):
        ranges = {name: _range(name, each, fixed) for name, each in written.items()}
        for name in ranges:
            if name in given:
                raise ValueError(f"{name} is given to all trials: leave it out here or there")
        for corner in _corners(ranges):
            list(composed([*settings, *as_lines(corner)]))
    return ranges


def as_lines(values: Mapping[str, Any]) -> list[str]:
    """Write settings as on the command line of ``train.py``."""
    return [f"{name}={as_text(value)}" for name, value in values.items()]


def _corners(ranges: Ranges) -> Iterator[dict[str, Any]]:
    """Yield the first value of all ranges together, then the second values, and so on.

    If the ends of a range are allowed, the numbers between them are.
    """
    ends = {name: _ends(each) for name, each in ranges.items()}
    for number in range(max(map(len, ends.values()))):
        yield {name: each[min(number, len(each) - 1)] for name, each in ends.items()}


def _ends(values: BaseDistribution) -> Sequence[Any]:
    """Return the ends of a range of numbers, or all choices."""
    if isinstance(values, IntDistribution | FloatDistribution):
        return values.low, values.high
    assert isinstance(values, CategoricalDistribution)
    return values.choices


def _range(name: str, written: Any, fixed: Mapping[str, Any]) -> BaseDistribution:
    """Return the range of a setting, as the file has it."""
    texts = [as_text(each) for each in written] if isinstance(written, list) else []
    # Its error suggests the nearest setting, or the choices of a group.
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
    # Optuna keeps words and numbers; other values become words as on the command line.
    return CategoricalDistribution(
        [each if each is None or _is_number(each) else as_text(each) for each in written]
    )


def _numbers(
    name: str, written: Mapping[Any, Any], *, whole: bool
) -> IntDistribution | FloatDistribution:
    """Return a range of numbers, whole numbers if the setting is one."""
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
    return IntDistribution(low, high, log) if whole else FloatDistribution(low, high, log)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
