"""Our parts by name in a Hydra file, beside TorchRL's groups, up to a trainer that trains."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torchrl.objectives import DDPGLoss, TD3Loss
from torchrl.trainers import Trainer

from tests.integration.test_torchrl_trainer import assert_learned
from torchrl_config import main, train
from torchrl_mpfa import (
    MPFASampler,
    SignalTensorStorage,
)
from torchrl_mpfa.integrations.trainer import PriorityStepper

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*Trainer is an experimental"),
    # Stages that the trainer itself uses.
    pytest.mark.filterwarnings("ignore:The '.*' hook stage:FutureWarning"),
    pytest.mark.filterwarnings("ignore:OptimizerHook:FutureWarning"),
]
EXAMPLES = Path(__file__).parents[2] / "examples"
TINY = [
    "frames=60",
    "storage.max_size=100",
    "replay_buffer.batch_size=4",
    "collector.frames_per_batch=20",
    "trainer.optim_steps_per_batch=3",
    "trainer.progress_bar=false",
    "actor.width=16",
    "critic.width=16",
]


@pytest.fixture(autouse=True)
def hydra_at_work() -> Iterator[None]:
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(EXAMPLES), version_base="1.3"):
        yield


def tiny(*overrides: str) -> Trainer:
    return train(compose("torchrl_config", [*TINY, *overrides]))


def test_the_composed_pipeline_updates_the_priorities_of_what_it_replays() -> None:
    trainer = tiny()
    assert_learned(trainer)
    assert trainer.optimization_stepper.priority_updates == 9
    buffer = trainer.replay_buffer
    assert type(buffer.sampler) is MPFASampler
    assert type(buffer.storage) is SignalTensorStorage
    assert type(trainer.loss_module) is DDPGLoss
    assert buffer.sampler.max_size == buffer.storage.max_size == 100


def test_the_policy_that_collects_has_the_weights_that_were_learned() -> None:
    trainer = tiny()
    learned = trainer.loss_module.actor_network_params.flatten_keys(".")
    collecting = dict(trainer.collector.policy.named_parameters())
    assert collecting
    for name, weights in collecting.items():
        assert weights.data_ptr() != learned[name].data_ptr()
        assert weights.equal(learned[name])


def test_many_robots_in_the_worlds_of_a_generator_are_one_setting_away() -> None:
    trainer = tiny("world=mixed", "env.base_env.num_envs=5")
    robots = trainer.replay_buffer[:]["collector", "traj_ids"][:20].unique()
    assert len(robots) >= 5
    assert_learned(trainer)


def test_the_configuration_of_the_page_builds_a_buffer() -> None:
    page = (EXAMPLES.parent / "docs" / "torchrl_trainer.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    given = OmegaConf.create(text)
    ConfigStore.instance().store(name="page", node=given)
    buffer = instantiate(compose("page").replay_buffer)
    assert [signal.name for signal in buffer.sampler.signals] == ["reward", "td_error", "novelty"]
    assert buffer.sampler.max_size == 100_000


def parts_of(algorithm: str) -> list[str]:
    """Groups and values of a trainer of TorchRL with the loss of the same algorithm."""
    choices = {"trainer": algorithm, "collector": "sync", "optimizer": "adam"}
    choices |= {"target_net_updater": "soft", "env": "transformed_env"}
    choices["transform@env.transform"] = "reward_sum"
    actor = "make_stochastic_actor" if algorithm == "sac" else "make_actor"
    values = {
        "sampler": "{_target_: torchrl_mpfa.MPFASampler, max_capacity: 100}",
        "storage": "{_target_: torchrl_mpfa.SignalTensorStorage, max_size: 100}",
        "replay_buffer": "{_target_: torchrl_mpfa.SignalReplayBuffer, storage: '${storage}', "
        "sampler: '${sampler}', batch_size: 4}",
        "actor": f"{{_target_: torchrl_mpfa.{actor}, observation_size: 24, action_size: 2}}",
        "critic": "{_target_: torchrl_mpfa.make_critic, observation_size: 24, action_size: 2}",
        "loss._target_": f"torchrl.objectives.{algorithm.upper()}Loss",
        "env.base_env": "{_target_: mpfa_envs.make_navigation_env, world: A, physics: kinematic}",
    }
    changes = {
        **{
            "env._partial_": "true",
            "collector.create_env_fn": "${env}",
            "collector.frames_per_batch": 20,
        },
        **{"collector.total_frames": 60, "trainer.total_frames": 60},
        **{"collector.auto_register_policy_transforms": "true"},
        **{f"trainer.{part}": f"${{{part}}}" for part in ("collector", "optimizer")},
        **{"trainer.replay_buffer": "${replay_buffer}", "trainer.loss_module": "${loss}"},
        **{"trainer.target_net_updater": "${target_net_updater}", "trainer.logger": "null"},
        **{"trainer.save_trainer_file": "null", "trainer.progress_bar": "false"},
        **{"trainer.optim_steps_per_batch": 3},
    }
    overrides = [f"+{group}={name}" for group, name in choices.items()]
    overrides += [f"++{name}={value}" for name, value in values.items()]
    return overrides + [f"{key}={value}" for key, value in changes.items()]


def test_td3_in_torchrls_td3_trainer_updates_priorities() -> None:
    more = ["+loss._partial_=true"]
    more += ["+loss.bounds=[-1.0,1.0]", "collector._partial_=true"]
    more += ["trainer.actor_network=${actor}", "trainer.qvalue_network=${critic}"]
    trainer = instantiate(compose(overrides=parts_of("td3") + more).trainer)
    PriorityStepper(trainer.optimization_stepper).register(trainer)
    trainer.train()
    assert type(trainer.loss_module) is TD3Loss
    assert_learned(trainer)


def test_the_script_trains_by_its_command_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    GlobalHydra.instance().clear()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        sys, "argv", ["torchrl_config.py", *TINY, "sampler._target_=torchrl_mpfa.SignalSampler"]
    )
    main()
    printed = capsys.readouterr().out
    assert "updates of priorities   9" in printed
    assert "signal td_error         weight 1.000" in printed
    assert list(tmp_path.iterdir()) == []


def test_a_seed_is_set_before_the_networks_are_made() -> None:
    config = compose("torchrl_config", [*TINY, "seed=5"])
    torch.manual_seed(5)
    expected = next(iter(instantiate(config.trainer).loss_module.parameters())).clone()
    torch.manual_seed(5)
    assert next(iter(instantiate(config.trainer).loss_module.parameters())).equal(expected)
