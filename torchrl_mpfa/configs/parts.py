"""Hydra configurations of samplers, storages, buffer, networks, losses and trainer hooks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from torchrl.trainers.algorithms.configs import (
    LazyMemmapStorageConfig,
    LazyTensorStorageConfig,
    TensorDictReplayBufferConfig,
)
from torchrl.trainers.algorithms.configs.data import SamplerConfig
from torchrl.trainers.algorithms.configs.hooks import HookConfig
from torchrl.trainers.algorithms.configs.modules import NetworkConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig

from torchrl_mpfa.buffer import SignalReplayBuffer
from torchrl_mpfa.configs.signatures import config_of
from torchrl_mpfa.integrations.trainer import PriorityStepper
from torchrl_mpfa.losses import (
    SignalDDPGLoss,
    SignalSACLoss,
    SignalTD3Loss,
    make_ddpg_loss,
    make_sac_loss,
    make_td3_loss,
)
from torchrl_mpfa.networks import make_actor, make_critic, make_stochastic_actor
from torchrl_mpfa.samplers import MPFASampler, SignalSampler
from torchrl_mpfa.signals import MPFA_SIGNALS, Signal
from torchrl_mpfa.storages import SignalMemmapStorage, SignalTensorStorage

_HERE = "torchrl_mpfa.configs.parts"


def _with_keys(made: Callable[..., Any], **options: Any) -> Any:
    """Call with nested keys where a configuration has lists."""
    if "reward_key" in options:
        options["reward_key"] = _key(options["reward_key"])
        options["allow_nonfinite"] = [_key(key) for key in options["allow_nonfinite"]]
    return made(**{**options, "signals": _signals(options["signals"])})


def _signals(signals: Sequence[Any]) -> list[Signal | str]:
    return [replace(s, key=_key(s.key)) if isinstance(s, Signal) else s for s in signals]


def _key(key: Any) -> Any:
    return tuple(key) if isinstance(key, list) else key


def _loss(
    made: Callable[..., Any],
    *,
    actor_network: Any,
    value_network: Any = None,
    qvalue_network: Any = None,
    **options: Any,
) -> Any:
    """A loss of networks that have other names in the function that makes it."""
    critic = qvalue_network if value_network is None else value_network
    return made(actor_network, critic, **options)


make_signal_sampler = partial(_with_keys, SignalSampler)
make_mpfa_sampler = partial(_with_keys, MPFASampler)
make_tensor_storage = partial(_with_keys, SignalTensorStorage)
make_memmap_storage = partial(_with_keys, SignalMemmapStorage)
make_ddpg = partial(_loss, make_ddpg_loss)
make_td3 = partial(_loss, make_td3_loss)
make_sac = partial(_loss, make_sac_loss)

# The capacity is that of the storage beside the sampler, wherever the two groups are placed. A type
# is no value of a configuration. Signals are names or configurations of Signal; fusion and
# adjustments are configurations.
_sampler_config = partial(
    config_of, base=SamplerConfig, leave_out=["dtype"], max_capacity="${..storage.max_size}"
)
SignalSamplerConfig = _sampler_config(
    SignalSampler, target=f"{_HERE}.make_signal_sampler", alpha=0.6, beta=0.4
)
MPFASamplerConfig = _sampler_config(
    MPFASampler,
    target=f"{_HERE}.make_mpfa_sampler",
    max_priority_within_buffer=True,
    signals=MPFA_SIGNALS,
    adjustments=None,
)
SignalTensorStorageConfig = config_of(
    SignalTensorStorage, LazyTensorStorageConfig, f"{_HERE}.make_tensor_storage"
)
SignalMemmapStorageConfig = config_of(
    SignalMemmapStorage, LazyMemmapStorageConfig, f"{_HERE}.make_memmap_storage"
)
SignalReplayBufferConfig = config_of(
    SignalReplayBuffer, TensorDictReplayBufferConfig, "torchrl_mpfa.SignalReplayBuffer"
)
ActorConfig = config_of(make_actor, NetworkConfig, "torchrl_mpfa.make_actor", name="ActorConfig")
CriticConfig = config_of(
    make_critic, NetworkConfig, "torchrl_mpfa.make_critic", name="CriticConfig"
)
StochasticActorConfig = config_of(
    make_stochastic_actor,
    NetworkConfig,
    "torchrl_mpfa.make_stochastic_actor",
    name="StochasticActorConfig",
)

# With the one-step target. Without networks a loss is instantiated with ``_partial_=True``: the
# trainer adds them.
_loss_config = partial(config_of, base=LossConfig, required=None, gamma=0.99, loss_function="l2")
_NOT_OF_A_LOSS = ["critic_network", "use_prioritized_weights", "priority_key", "skip_done_states"]
SignalDDPGLossConfig = _loss_config(
    SignalDDPGLoss, target=f"{_HERE}.make_ddpg", leave_out=_NOT_OF_A_LOSS
)
SignalTD3LossConfig = _loss_config(
    SignalTD3Loss, target=f"{_HERE}.make_td3", leave_out=_NOT_OF_A_LOSS
)
SignalSACLossConfig = _loss_config(
    SignalSACLoss,
    target=f"{_HERE}.make_sac",
    leave_out=[*_NOT_OF_A_LOSS, "value_network", "delay_value", "delay_actor"],
)
PriorityStepperConfig = config_of(
    PriorityStepper, HookConfig, "torchrl_mpfa.integrations.trainer.PriorityStepper"
)
