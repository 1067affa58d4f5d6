"""The text of ``train.py --help``, without the parts of a run, which take seconds to import."""

from __future__ import annotations

from collections.abc import Sequence

from hydra import compose, initialize_config_module
from hydra.errors import HydraException
from omegaconf import OmegaConf

from training.plugins import with_plugin
from training.settings.from_file import with_lines
from training.settings.train import GROUPS, register

_TEXT = """{usage}
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
    return _TEXT.format(usage=usage, groups="\n".join(groups), settings=OmegaConf.to_yaml(settings))
