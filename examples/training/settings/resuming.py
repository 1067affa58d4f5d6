"""Settings of a run that resumes: which may change, and which may not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from training.settings.command_line import choices_of
from training.settings.rules import settings_by_name
from training.settings.train import (
    GROUPS,
    REGIMES,
    SEVERAL,
    Stage,
    TrackingSettings,
    TrainSettings,
    as_settings,
    curriculum_name,
)

LAWFUL = (
    "curriculum.name",
    "evaluation.every",
    "checkpoint_every",
    "plugin",
    "tracking.mode",
    "tracking.csv",
    "tracking.tensorboard",
    "tracking.project",
    "tracking.group",
    "tracking.log_every",
    "tracking.pictures_every",
)
"""Settings that a resumed run may change; its episodes may become more, too."""
OF_THE_CALL = ("resume", "run_dir", "overwrite")
"""Settings of the call, which are not part of a run."""


def changed(saved: dict[str, Any], overrides: list[Override]) -> TrainSettings:
    """Return the settings of a run, changed by a command line."""
    before = as_settings(saved)
    config = OmegaConf.structured(before)
    for override in overrides:
        key, value = override.key_or_group, override.value()
        if key in OF_THE_CALL:
            continue
        if key in GROUPS and key != "regime":
            chosen = [GROUPS[key][word] for word in choices_of(override)]
            if key == SEVERAL:
                chosen.insert(0, TrackingSettings)
            # As at the start of the run, its regime has values of its own for any choice.
            config[key] = OmegaConf.merge(*chosen, REGIMES[before.regime].get(key, {}))
        else:
            OmegaConf.update(config, key, value)
    if config.actions is not None:
        config.curriculum.stages = _lengthened(before.curriculum.stages, config.actions)
        config.actions = None
    was_derived = before.curriculum.name == curriculum_name(before.curriculum.stages)
    named = any(override.key_or_group == "curriculum.name" for override in overrides)
    if was_derived and not named:
        config.curriculum.name = None
    return as_settings(config)


def _lengthened(stages: Sequence[Stage], actions: int) -> list[Stage]:
    """Return stages of so many actions in all, of which the last stage has what is left."""
    *fixed, last = stages
    so_far = sum(each.actions for each in stages)
    if last.actions and actions < so_far:
        raise ValueError(
            f"resume: actions must be at least the {so_far} of the run, got {actions}: leave it "
            "out, or give more"
        )
    if not last.actions:
        raise ValueError(
            "resume: actions must be null in a run that counts episodes, got "
            f"{actions}: lengthen the last of its curriculum.stages"
        )
    return [*fixed, replace(last, actions=actions - sum(each.actions for each in fixed))]


def check_single(overrides: list[Override]) -> None:
    """Raise for settings of several runs, as a sweep has them."""
    for override in overrides:
        if override.is_sweep_override():
            key, _, values = (override.input_line or "").partition("=")
            several = f": several are {key}=[{values}]" if key == SEVERAL else ""
            raise ValueError(f"resume: a run takes one value, got {key}={values}{several}")


def check_lawful(before: TrainSettings, after: TrainSettings, folder: Path) -> None:
    """Raise if a resumed run would change a setting that is fixed."""
    old, new = dict(settings_by_name(before)), dict(settings_by_name(after))
    fixed = [n for n in new if n not in (*LAWFUL, *OF_THE_CALL, "curriculum.stages")]
    wrong = [f"{name}={new[name]} (it has {old[name]})" for name in fixed if new[name] != old[name]]
    if wrong:
        raise ValueError(f"resume: the run in {folder} cannot change {', '.join(wrong)}")
    if not extends(before.curriculum.stages, after.curriculum.stages):
        raise ValueError(
            f"resume: curriculum.stages may have more episodes in its last stage or more stages "
            f"after it, the run in {folder} has {_short(before)}, got {_short(after)}"
        )


def extends(before: list[Stage], after: list[Stage]) -> bool:
    """Return True if stages continue others, whose last one may have become longer."""
    *fixed, last = before
    count = len(fixed)
    if len(after) <= count or after[:count] != fixed:
        return False
    same = after[count].world == last.world and bool(after[count].episodes) == bool(last.episodes)
    return same and after[count].length >= last.length


def _short(settings: TrainSettings) -> str:
    stages = settings.curriculum.stages
    return "[" + ", ".join(f"{stage.world}: {stage.length}" for stage in stages) + "]"
