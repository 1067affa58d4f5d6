"""The pipeline of ``torchrl_trainer.py``, composed from Hydra's groups, TorchRL's and our own.

    python examples/torchrl_config.py
    python examples/torchrl_config.py sampler=signal sampler.alpha=0.7 storage=signal_memmap
    python examples/torchrl_config.py sampler=random frames=20000 optimizer=adamw
    python examples/torchrl_config.py world=mixed env.base_env.num_envs=20    many robots
    python examples/torchrl_config.py --cfg job

``torchrl_config.yaml`` has every choice.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import hydra
import torch
from hydra.core.config_store import ConfigStore
from hydra.utils import instantiate
from omegaconf import DictConfig
from torchrl.trainers import Trainer
from torchrl.trainers.algorithms.configs import EnvConfig

from torchrl_mpfa.integrations.hydra import register_configs
from torchrl_trainer import close_progress_bar, report, silence
from training.settings.from_file import quoted


@dataclass
class NavigationEnvConfig(EnvConfig):
    """The navigation task for TorchRL's group ``env``."""

    world: str = "A"
    num_envs: int | None = None
    physics: str = "kinematic"
    info_keys: list[str] = field(default_factory=list)
    seed: int | None = None
    _target_: str = "mpfa_envs.make_navigation_env"


def register() -> None:
    """Add our configurations to TorchRL's groups."""
    register_configs()
    ConfigStore.instance().store(group="env", name="navigation", node=NavigationEnvConfig)


def train(config: DictConfig) -> Trainer:
    """Build what the configuration describes, and train it."""
    torch.manual_seed(config.seed)
    trainer = instantiate(config.trainer)
    trainer.train()
    return trainer


def run(config: DictConfig) -> None:
    """Train, and say what happened."""
    silence()
    torch.set_num_threads(1)
    trainer = train(config)
    close_progress_bar(trainer)
    print(*report(trainer), sep="\n")


def main() -> None:
    """Hand over to Hydra."""
    register()
    folder = str(Path(__file__).parent.resolve())
    sys.argv[1:] = map(quoted, sys.argv[1:])
    hydra.main(version_base="1.3", config_path=folder, config_name="torchrl_config")(run)()


if __name__ == "__main__":
    main()
