"""What ``train.py`` does with its command line: one run, a sweep, or a run that resumes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from training.files import check_folder
from training.run.hooks import Hook
from training.run.running import Refused, resume, start
from training.settings.command_line import composed, parse_overrides
from training.settings.from_file import with_lines
from training.settings.train import as_settings, register

REFUSED = 2
_SWEEP = ("-m", "--multirun")


def refuse(error: Exception) -> NoReturn:
    """Say in one line what is wrong."""
    print(f"train.py: {error}", file=sys.stderr)
    raise SystemExit(REFUSED)


def train(arguments: list[str], hooks: Sequence[Hook] = ()) -> None:
    """Check the command line, which Hydra reads as well, then train.

    Args:
        arguments: The settings, ``sys.argv[1:]``.
        hooks: What is called on the way; each run of a sweep calls the same ones.

    Raises:
        SystemExit: Unless the exit status is 0; ``train.py`` lists the others.
    """
    register()
    try:
        overrides = parse_overrides(arguments)
        folders = [o.value() for o in overrides if o.key_or_group == "resume"]
        resumes = bool(folders) and folders[-1] is not None
        runs = [] if resumes else list(composed(arguments))
        named = any(override.key_or_group == "run_dir" for override in overrides)
        if named and any(option in arguments for option in _SWEEP) and not resumes:
            raise ValueError(
                "run_dir is for one run: those of a sweep have their settings as names, in the "
                "folder hydra.sweep.dir=FOLDER"
            )
        for settings in runs:
            check_folder(Path(settings.run_dir))
    except ValueError as error:
        refuse(error)
    if resumes:
        _end_with(lambda: resume(Path(str(folders[-1])), overrides, hooks))
    elif len(runs) == 1 and not any(text.startswith(("-", "hydra")) for text in arguments):
        _end_with(lambda: start(runs[0], Path(runs[0].run_dir), hooks))
    else:
        # Sweeps, and whatever else Hydra can; it composes the settings once more.
        def run(config: DictConfig) -> None:
            folder = Path(HydraConfig.get().runtime.output_dir)
            _end_with(lambda: start(as_settings(config), folder, hooks))

        sys.argv[1:] = with_lines(arguments)
        hydra.main(version_base="1.3", config_path=None, config_name="train")(run)()


def _end_with(run: Callable[[], int]) -> None:
    """Run; the exit status of the script is that of the run."""
    try:
        status = run()
    except Refused as error:
        refuse(error)
    if status:
        raise SystemExit(status)
