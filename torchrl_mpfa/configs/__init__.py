"""Hydra configurations of the replay parts, for TorchRL's own groups.

TorchRL composes trainers out of groups of configurations (``torchrl.trainers.algorithms.configs``).
:func:`register_configs` adds those of this package to them: ``sampler=mpfa``,
``storage=signal_tensor``, ``replay_buffer=signal``, ``loss=signal_ddpg``. A whole method is one
entry: ``replay_buffer=signal_mpfa_per`` is its buffer, and ``replay=la3p``, in a group of this
package, is what :func:`~torchrl_mpfa.methods.make_replay` makes, with the selection that LA3P and
KLPER need. Hydra is needed here and nowhere else in the package, which does not import this module
by itself.
"""

from torchrl.trainers.algorithms.configs import ConfigStore

from torchrl_mpfa.configs.methods import METHOD_CONFIGS
from torchrl_mpfa.configs.parts import (
    ActorConfig,
    CriticConfig,
    MPFASamplerConfig,
    PriorityStepperConfig,
    SignalDDPGLossConfig,
    SignalMemmapStorageConfig,
    SignalReplayBufferConfig,
    SignalSACLossConfig,
    SignalSamplerConfig,
    SignalTD3LossConfig,
    SignalTensorStorageConfig,
    StochasticActorConfig,
)

__all__ = [
    "CONFIGS",
    "ActorConfig",
    "CriticConfig",
    "MPFASamplerConfig",
    "PriorityStepperConfig",
    "SignalDDPGLossConfig",
    "SignalMemmapStorageConfig",
    "SignalReplayBufferConfig",
    "SignalSACLossConfig",
    "SignalSamplerConfig",
    "SignalTD3LossConfig",
    "SignalTensorStorageConfig",
    "StochasticActorConfig",
    "register_configs",
]

CONFIGS: dict[tuple[str, str], type] = {
    ("sampler", "mpfa"): MPFASamplerConfig,
    ("sampler", "signal"): SignalSamplerConfig,
    ("storage", "signal_tensor"): SignalTensorStorageConfig,
    ("storage", "signal_memmap"): SignalMemmapStorageConfig,
    ("replay_buffer", "signal"): SignalReplayBufferConfig,
    ("loss", "signal_ddpg"): SignalDDPGLossConfig,
    ("loss", "signal_td3"): SignalTD3LossConfig,
    ("loss", "signal_sac"): SignalSACLossConfig,
    ("network", "signal_actor"): ActorConfig,
    ("network", "signal_stochastic_actor"): StochasticActorConfig,
    ("network", "signal_critic"): CriticConfig,
    ("hook", "priority_stepper"): PriorityStepperConfig,
    **METHOD_CONFIGS,
}
"""The configurations by group, TorchRL's or ``replay``, and by name."""


def register_configs() -> None:
    """Add the configurations of this package to TorchRL's groups in Hydra's store.

    TorchRL's own are there as soon as this module is imported. A second call changes nothing.

    Examples:
        >>> register_configs()
        >>> sorted(name for group, name in CONFIGS if group == "sampler")
        ['mpfa', 'signal']
    """
    store = ConfigStore.instance()
    for (group, name), node in CONFIGS.items():
        store.store(group=group, name=name, node=node)
