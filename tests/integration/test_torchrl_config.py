"""Our parts out of Hydra's groups, beside TorchRL's own, up to a trainer that trains."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torchrl.data import LazyMemmapStorage, RandomSampler
from torchrl.objectives import DDPGLoss, SACLoss, TD3Loss
from torchrl.trainers import Trainer

from tests.integration.test_torchrl_trainer import assert_learned
from torchrl_config import main, register, train
from torchrl_mpfa import (
    FixedFusion,
    MPFASampler,
    Signal,
    SignalDDPGLoss,
    SignalMemmapStorage,
    SignalSACLoss,
    SignalSampler,
    SignalTD3Loss,
    SignalTensorStorage,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_stochastic_actor,
)
from torchrl_mpfa.integrations.hydra import (
    CONFIGS,
    ActorConfig,
    CriticConfig,
    MPFASamplerConfig,
    SignalDDPGLossConfig,
    SignalMemmapStorageConfig,
    SignalSACLossConfig,
    SignalSamplerConfig,
    SignalTD3LossConfig,
    SignalTensorStorageConfig,
    StochasticActorConfig,
)
from torchrl_mpfa.integrations.trainer import PriorityStepper
from torchrl_mpfa.losses import SignalLoss

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


@pytest.fixture(scope="module", autouse=True)
def registered() -> None:
    register()


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
    assert type(trainer.loss_module) is SignalDDPGLoss
    assert buffer.sampler.max_size == buffer.storage.max_size == 100


def test_the_policy_that_collects_has_the_weights_that_were_learned() -> None:
    trainer = tiny()
    learned = trainer.loss_module.actor_network_params.flatten_keys(".")
    collecting = dict(trainer.collector.policy.named_parameters())
    assert collecting
    for name, weights in collecting.items():
        assert weights.data_ptr() != learned[name].data_ptr()
        assert weights.equal(learned[name])


def test_two_runs_of_one_seed_are_the_same() -> None:
    first, second = (tiny("seed=3").replay_buffer.storage.signal_table.rows for _ in range(2))
    assert first.nan_to_num(-1).equal(second.nan_to_num(-1))


def test_other_choices_of_the_groups_fit_the_same_places() -> None:
    trainer = tiny("sampler=signal", "sampler.alpha=0.7", "storage=signal_memmap")
    assert type(trainer.replay_buffer.sampler) is SignalSampler
    assert trainer.replay_buffer.sampler.alpha == 0.7
    assert type(trainer.replay_buffer.storage) is SignalMemmapStorage
    assert_learned(trainer, "td_error")


def test_torchrls_own_sampler_and_storage_fit_as_well() -> None:
    trainer = tiny("sampler=random", "storage=lazy_memmap")
    assert type(trainer.replay_buffer.sampler) is RandomSampler
    assert type(trainer.replay_buffer.storage) is LazyMemmapStorage
    assert len(trainer.replay_buffer) == 60


def test_many_robots_in_the_worlds_of_a_generator_are_one_setting_away() -> None:
    trainer = tiny("world=mixed", "env.base_env.num_envs=5")
    robots = trainer.replay_buffer[:]["collector", "traj_ids"][:20].unique()
    assert len(robots) >= 5
    assert_learned(trainer)


def test_torchrls_own_networks_fit_the_loss() -> None:
    critic = "{_target_: torchrl.modules.ValueOperator, module: ${mlp}, "
    critic += "in_keys: [observation, action], out_keys: [state_action_value]}"
    trainer = tiny(
        "+network@mlp=mlp",
        "mlp.in_features=26",
        "mlp.out_features=1",
        "mlp.num_cells=[16]",
        f"loss.value_network={critic}",
    )
    assert_learned(trainer)


def test_a_storage_without_signals_is_rejected_by_name() -> None:
    with pytest.raises(Exception, match=r"storage must keep signals.*got LazyTensorStorage"):
        tiny("storage=lazy_tensor")


def test_the_capacity_of_a_sampler_is_that_of_the_storage_beside_it() -> None:
    groups = [
        "+replay_buffer=signal",
        "+sampler@replay_buffer.sampler=mpfa",
        "+storage@replay_buffer.storage=signal_tensor",
        "replay_buffer.storage.max_size=32",
    ]
    buffer = instantiate(compose(overrides=groups).replay_buffer)
    assert buffer.sampler.max_size == buffer.storage.max_size == 32


def test_the_configuration_of_the_page_builds_a_buffer() -> None:
    page = (EXAMPLES.parent / "docs" / "torchrl_trainer.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    given = OmegaConf.create(text)
    ConfigStore.instance().store(name="page", node=given)
    buffer = instantiate(compose("page").replay_buffer)
    assert [signal.name for signal in buffer.sampler.signals] == ["reward", "td_error", "novelty"]
    assert buffer.sampler.max_size == 100_000


def test_fusion_adjustments_and_signals_are_configurations_of_their_own() -> None:
    novelty = {"_target_": "torchrl_mpfa.Signal", "name": "novelty", "key": ["info", "novelty"]}
    config = MPFASamplerConfig(
        max_capacity=10,
        signals=["reward", novelty],
        fusion={"_target_": "torchrl_mpfa.FixedFusion", "values": {"reward": 1.0, "novelty": 2.0}},
        adjustments=[{"_target_": "torchrl_mpfa.PositiveBoost", "boost": 2.0}],
    )
    sampler = instantiate(config)
    assert sampler.fusion == FixedFusion({"reward": 1.0, "novelty": 2.0})
    assert sampler.signals[1] == Signal("novelty", key=("info", "novelty"))
    assert [adjust.boost for adjust in sampler.adjustments] == [2.0]
    storage = instantiate(SignalTensorStorageConfig(max_size=10, signals=["reward", novelty]))
    assert storage.signal_table.names == ["novelty", "reward"]
    assert storage.signal_table.reward_key == ("next", "reward")


@pytest.mark.parametrize(
    ("config", "made", "left_out"),
    [
        # A type is no value of a configuration.
        (SignalSamplerConfig, SignalSampler, {"dtype"}),
        (MPFASamplerConfig, MPFASampler, {"dtype"}),
        (SignalTensorStorageConfig, SignalTensorStorage, set()),
        (SignalMemmapStorageConfig, SignalMemmapStorage, set()),
        (ActorConfig, make_actor, set()),
        (StochasticActorConfig, make_stochastic_actor, set()),
        (CriticConfig, make_critic, set()),
    ],
)
def test_every_argument_is_a_field_with_the_same_default(
    config: type, made: type, left_out: set[str]
) -> None:
    function = made.__init__ if inspect.isclass(made) else made
    arguments = {
        name: parameter
        for name, parameter in inspect.signature(function).parameters.items()
        if name not in {"self", *left_out}
        and parameter.kind not in {parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL}
    }
    assert set(arguments) <= {field.name for field in fields(config)}
    if made is SignalSampler:
        return  # By default PER.
    defaults = OmegaConf.structured(config)
    for name, parameter in arguments.items():
        if isinstance(parameter.default, bool | int | float | str):
            assert defaults[name] == parameter.default, name


# What a loss sets itself, what TorchRL has removed, and what belongs to SAC's first version.
NOT_OF_A_LOSS = {
    "use_prioritized_weights",
    "priority_key",
    "value_network",
    "delay_value",
    "skip_done_states",
}


@pytest.mark.parametrize(
    ("config", "ours", "theirs"),
    [
        (SignalDDPGLossConfig, SignalDDPGLoss, DDPGLoss),
        (SignalTD3LossConfig, SignalTD3Loss, TD3Loss),
        (SignalSACLossConfig, SignalSACLoss, SACLoss),
    ],
)
def test_every_option_of_a_loss_is_a_field_and_the_other_way_around(
    config: type, ours: type, theirs: type
) -> None:
    defaults: dict[str, object] = {"gamma": 0.99, "loss_function": "l2"}
    for made in (ours, SignalLoss, theirs):
        for name, parameter in inspect.signature(made.__init__).parameters.items():
            if name not in {"self", "args", "kwargs", "critic_network"}:
                defaults.setdefault(name, parameter.default)
    left_out = NOT_OF_A_LOSS - ({"value_network", "delay_value"} if theirs is DDPGLoss else set())
    if theirs is SACLoss:
        left_out |= {"delay_actor"}  # Its targets ask the current policy.
    names = {field.name for field in fields(config) if not field.name.startswith("_")}
    assert names == set(defaults) - left_out
    made = OmegaConf.structured(config)
    for name in names:
        if isinstance(defaults[name], bool | int | float | str):
            assert made[name] == defaults[name], name


def test_every_configuration_is_in_a_group_that_torchrl_has() -> None:
    repo = ConfigStore.instance().repo
    for group, name in CONFIGS:
        if group == "replay":
            continue  # Whole methods with their selection, which TorchRL has no place for.
        others = {file.removesuffix(".yaml") for file in repo[group]}
        assert name in others
        assert others - {own for at, own in CONFIGS if at == group}, group


def parts_of(algorithm: str) -> list[str]:
    """Groups and values of a trainer of TorchRL with the loss of the same algorithm."""
    choices = {
        **{"sampler": "mpfa", "storage": "signal_tensor", "replay_buffer": "signal"},
        **{"loss": f"signal_{algorithm}", "trainer": algorithm},
        **{"collector": "sync", "optimizer": "adam"},
        **{"env": "navigation", "target_net_updater": "soft"},
        **{"network@actor": "signal_actor", "network@critic": "signal_critic"},
    }
    if algorithm == "sac":
        choices["network@actor"] = "signal_stochastic_actor"
    values = {
        **{"replay_buffer.storage": "${storage}", "replay_buffer.sampler": "${sampler}"},
        **{"storage.max_size": 100, "replay_buffer.batch_size": 4},
        **{f"{net}.observation_size": 24 for net in ("actor", "critic")},
        **{f"{net}.action_size": 2 for net in ("actor", "critic")},
        **{"env._partial_": "true"},
        **{"collector.create_env_fn": "${env}", "collector.frames_per_batch": 20},
        **{"collector.total_frames": 60, "trainer.total_frames": 60},
        **{"collector.auto_register_policy_transforms": "true"},
        **{f"trainer.{part}": f"${{{part}}}" for part in ("collector", "optimizer")},
        **{"trainer.replay_buffer": "${replay_buffer}", "trainer.loss_module": "${loss}"},
        **{"trainer.target_net_updater": "${target_net_updater}", "trainer.logger": "null"},
        **{"trainer.save_trainer_file": "null", "trainer.progress_bar": "false"},
        **{"trainer.optim_steps_per_batch": 3},
    }
    overrides = [f"+{group}={name}" for group, name in choices.items()]
    return overrides + [f"{key}={value}" for key, value in values.items()]


def test_td3_in_torchrls_td3_trainer_updates_priorities() -> None:
    more = ["loss._partial_=true", "collector._partial_=true"]
    more += ["trainer.actor_network=${actor}", "trainer.qvalue_network=${critic}"]
    trainer = instantiate(compose(overrides=parts_of("td3") + more).trainer)
    trainer.train()
    assert type(trainer.loss_module) is SignalTD3Loss
    assert_learned(trainer)


def test_sac_in_torchrls_sac_trainer_updates_priorities() -> None:
    more = ["collector.policy=${actor}", "loss.actor_network=${actor}"]
    more += ["loss.qvalue_network=${critic}", "loss.reward_scale=0.1", "loss.alpha_init=0.2"]
    more += ["trainer.log_rewards=false"]
    trainer = instantiate(compose(overrides=parts_of("sac") + more).trainer)
    PriorityStepper().register(trainer)
    trainer.train()
    assert type(trainer.loss_module) is SignalSACLoss
    assert float(trainer.loss_module.alpha_init) == pytest.approx(0.2)
    assert_learned(trainer)


def test_a_loss_without_networks_waits_for_them() -> None:
    partial = instantiate(SignalDDPGLossConfig(_partial_=True, gamma=0.5))
    networks = make_actor(24, 2, width=8), make_critic(24, 2, width=8)
    made = partial(actor_network=networks[0], value_network=networks[1])
    assert float(made.value_estimator.gamma) == 0.5
    assert made.importance == make_ddpg_loss(*networks).importance


def test_the_script_trains_by_its_command_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    GlobalHydra.instance().clear()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["torchrl_config.py", *TINY, "sampler=signal"])
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
