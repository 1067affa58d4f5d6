"""Our parts by name in a Hydra file, beside TorchRL's groups, up to a trainer that trains."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import torchrl.trainers.algorithms.configs  # noqa: F401  Adds TorchRL's groups.
from hydra import compose, initialize
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torchrl.objectives import TD3Loss

from tests.integration.test_torchrl_trainer import assert_learned
from torchrl_mpfa.integrations.trainer import PriorityStepper

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*Trainer is an experimental"),
    # Stages that the trainer itself uses.
    pytest.mark.filterwarnings("ignore:The '.*' hook stage:FutureWarning"),
    pytest.mark.filterwarnings("ignore:OptimizerHook:FutureWarning"),
]
DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(autouse=True)
def hydra_at_work() -> Iterator[None]:
    GlobalHydra.instance().clear()
    with initialize(config_path=None, version_base="1.3"):
        yield


def test_the_configuration_of_the_page_builds_a_buffer() -> None:
    page = (DOCS / "torchrl_trainer.md").read_text(encoding="utf-8")
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
