"""Variables of the environment that belong to a single run, or switch a log off."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from training.settings.train import TrackingSettings

OF_ONE_RUN = (
    "WANDB_RUN_ID",
    "WANDB_NAME",
    "WANDB_RESUME",
    "WANDB_SWEEP_ID",
    "WANDB_SWEEP_PARAM_PATH",
)
"""Variables by which several runs would become one, as a job or an agent of wandb sets them."""
_MODES = {"run": "online", "dryrun": "offline"}
"""Older names of wandb's modes."""


_DECIDED_BY = {
    "WANDB_PROJECT": "tracking.project",
    "WANDB_RUN_GROUP": "tracking.group",
    "WANDB_NAME": "run_dir",
    "WANDB_DIR": "run_dir",
}


def forget_single_run() -> None:
    """Leave the variables of a single run to none of several runs, and print a line on them."""
    given = [name for name in OF_ONE_RUN if os.environ.pop(name, None) is not None]
    if given:
        print(f"{', '.join(given)}: of a single run, ignored by several", file=sys.stderr)


def with_environment(wanted: TrackingSettings) -> TrackingSettings:
    """Return settings of the logs without wandb if the environment switches it off.

    What the settings of the run decide has no effect; a line says so.
    """
    if wanted.mode == "off":
        return wanted
    off = os.environ.get("WANDB_DISABLED", "").lower() in ("true", "1", "yes", "on")
    mode = os.environ.get("WANDB_MODE") or wanted.mode
    if off or mode == "disabled":
        name = "WANDB_MODE" if mode == "disabled" else "WANDB_DISABLED"
        print(f"{name}={os.environ[name]}: wandb gets no log", file=sys.stderr)
        return replace(wanted, mode="off")
    if _MODES.get(mode, mode) != wanted.mode:
        choice = "online" if _MODES.get(mode, mode) == "online" else "wandb"
        print(
            f"WANDB_MODE={mode} has no effect, tracking.mode={wanted.mode} has: tracking={choice} "
            "is the other mode",
            file=sys.stderr,
        )
    for name in _DECIDED_BY.keys() & os.environ.keys():
        print(f"{name} has no effect, {_DECIDED_BY[name]} has", file=sys.stderr)
    return wanted
