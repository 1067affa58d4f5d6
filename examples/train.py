"""Train a navigation policy with any method and learner.

    python examples/train.py                              MPFA-PER, 16 robots, new worlds
    python examples/train.py method=per seed=3            another method, another seed
    python examples/train.py regime=paper                 Table 1, one robot, worlds A, B, C, D
    python examples/train.py regime=paper curriculum=A    only world A
    python examples/train.py -m seed=0,1,2 method=mpfa_per,per    a sweep, in hydra.sweep.dir
    python examples/train.py ray.workers=8 robots=128 updates=32    robots on a Ray cluster
    python examples/train.py resume=runs/rooms-mpfa_per-ddpg-0    resume a run that was stopped

``navigation/settings/`` has every setting; ``--help`` prints them with their values. Ctrl-C,
SIGTERM and SIGHUP let the iteration end and save. Exit status: 0; 1 after an error, with the last
iteration saved; 2 if a setting is wrong; 128 plus the number of the signal that stopped it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from navigation.files import check_folder
from navigation.settings.command_line import composed, parse_overrides
from navigation.settings.train import as_settings, register
from navigation.training.running import Refused, resume, start

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


def refuse(error: Exception) -> None:
    """Say in one line what is wrong."""
    print(f"train.py: {error}", file=sys.stderr)
    raise SystemExit(REFUSED)


def main() -> None:
    """Check the command line, then train."""
    register()
    arguments = sys.argv[1:]
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


if __name__ == "__main__":
    main()
