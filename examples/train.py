"""Train a navigation policy with any method and learner.

    python examples/train.py                              MPFA-PER on map A
    python examples/train.py method=per seed=3            another method, another seed
    python examples/train.py curriculum=paper             maps A, B, C, D one after the other
    python examples/train.py -m seed=0,1,2 method=mpfa_per,per    a sweep
    python examples/train.py resume=runs/A-mpfa_per-ddpg-0    go on with a run that was stopped

``settings.py`` has every setting; ``--help`` prints them with their values.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from overrides import check_overrides
from process import prepare_process
from records import draw_learning_curve
from settings import TrainSettings, register
from training import CHECKPOINT, TrainingRun, read_checkpoint

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""


def as_settings(config: DictConfig | dict[str, Any]) -> TrainSettings:
    """Typed settings from what Hydra composed or a checkpoint holds."""
    values = OmegaConf.create(config) if isinstance(config, dict) else config.copy()
    OmegaConf.set_struct(values, False)
    for name in ("defaults", "hydra"):
        values.pop(name, None)
    merged = OmegaConf.merge(OmegaConf.structured(TrainSettings), values)
    merged.pop("hydra", None)
    settings = OmegaConf.to_object(merged)
    assert isinstance(settings, TrainSettings)
    return settings


def run(config: DictConfig) -> None:
    """Train, save, draw."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    resume = config.resume
    state = None
    if resume is not None:
        folder = Path(resume)
        state = read_checkpoint(folder)
        settings = as_settings(state["settings"])
    else:
        settings = as_settings(config)
        if (folder / CHECKPOINT).exists() and not settings.overwrite:
            raise SystemExit(
                f"{folder} holds a run: go on with it by resume={folder}, or start anew by "
                "overwrite=true"
            )
    prepare_process(settings)
    training = TrainingRun(settings, folder)
    try:
        if state is not None:
            training.load(state)
        finished = training.train()
    finally:
        training.close()
    if training.records:
        draw_learning_curve(training.records, folder / "learning_curve.png")
    if finished:
        print(f"policy: {folder / 'policy.pt'}   curve: {folder / 'learning_curve.png'}")
    else:
        print(f"stopped after episode {training.episode}; go on with: train.py resume={folder}")
        raise SystemExit(INTERRUPTED)


def main() -> None:
    """Check the command line, then hand over to Hydra."""
    register()
    check_overrides(sys.argv[1:])
    hydra.main(version_base="1.3", config_path=None, config_name="train")(run)()


if __name__ == "__main__":
    main()
