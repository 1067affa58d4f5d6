"""What ``train.py`` does with its command line: one run, a sweep, or a run that resumes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from training.files import check_folder
from training.run.running import Refused, resume, start
from training.settings.command_line import composed, parse_overrides
from training.settings.train import as_settings, register

REFUSED = 2
_SWEEP = ("-m", "--multirun")


def run(config: DictConfig) -> None:
    """One run, in the folder that Hydra found for it."""
    try:
        status = start(as_settings(config), Path(HydraConfig.get().runtime.output_dir))
    except Refused as error:
        refuse(error)
    if status:
        raise SystemExit(status)


def refuse(error: Exception) -> NoReturn:
    """Say in one line what is wrong."""
    print(f"train.py: {error}", file=sys.stderr)
    raise SystemExit(REFUSED)


def train(arguments: list[str]) -> None:
    """Check the command line, which Hydra reads as well, then train."""
    register()
    try:
        overrides = parse_overrides(arguments)
        folders = [o.value() for o in overrides if o.key_or_group == "resume"]
        if folders and folders[-1] is not None:
            raise SystemExit(resume(Path(str(folders[-1])), overrides))
        named = any(override.key_or_group == "run_dir" for override in overrides)
        if named and any(option in arguments for option in _SWEEP):
            raise ValueError(
                "run_dir is for one run: those of a sweep have their settings as names, in the "
                "folder hydra.sweep.dir=FOLDER"
            )
        for settings in composed(arguments):
            check_folder(Path(settings.run_dir))
    except (ValueError, Refused) as error:
        refuse(error)
    hydra.main(version_base="1.3", config_path=None, config_name="train")(run)()
