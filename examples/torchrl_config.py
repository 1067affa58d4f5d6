"""The pipeline of ``torchrl_trainer.py``, from a file: TorchRL's groups, our parts by ``_target_``.

    python examples/torchrl_config.py
    python examples/torchrl_config.py sampler._target_=torchrl_mpfa.SignalSampler sampler.alpha=0.7
    python examples/torchrl_config.py frames=20000 optimizer=adamw
    python examples/torchrl_config.py world=mixed env.base_env.num_envs=20    many robots
    python examples/torchrl_config.py --cfg job

``torchrl_config.yaml`` has every choice.
"""

from __future__ import annotations

import sys
from pathlib import Path

import hydra
import torch
import torchrl.trainers.algorithms.configs  # noqa: F401  Adds TorchRL's groups.
from hydra.utils import instantiate
from omegaconf import DictConfig
from torchrl.trainers import Trainer

from torchrl_trainer import close_progress_bar, report, silence
from training.settings.command_line import quoted


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
    folder = str(Path(__file__).parent.resolve())
    sys.argv[1:] = map(quoted, sys.argv[1:])
    hydra.main(version_base="1.3", config_path=folder, config_name="torchrl_config")(run)()


if __name__ == "__main__":
    main()
