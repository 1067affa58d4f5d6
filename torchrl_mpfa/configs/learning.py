"""Hydra configurations of networks, losses and trainer hooks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torchrl.trainers.algorithms.configs.hooks import HookConfig
from torchrl.trainers.algorithms.configs.modules import NetworkConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig

from torchrl_mpfa.losses import (
    SignalDDPGLoss,
    SignalSACLoss,
    SignalTD3Loss,
    make_ddpg_loss,
    make_sac_loss,
    make_td3_loss,
)
from torchrl_mpfa.losses.base import DEFAULT_SIGNALS


@dataclass
class PerceptronConfig(NetworkConfig):
    """What the configurations of the networks share."""

    observation_size: Any = "???"
    action_size: Any = "???"
    width: int = 256
    layers: int = 2
    layer_norm: bool = True
    final_init: float | None = 3e-3


@dataclass
class ActorConfig(PerceptronConfig):
    """Configuration of :func:`~torchrl_mpfa.make_actor`.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(ActorConfig(observation_size=24, action_size=2)).out_keys
        ['preactivation', 'action']
    """

    action_spec: Any = None
    _target_: str = "torchrl_mpfa.make_actor"


@dataclass
class CriticConfig(PerceptronConfig):
    """Configuration of :func:`~torchrl_mpfa.make_critic`.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(CriticConfig(observation_size=24, action_size=2)).out_keys
        ['state_action_value']
    """

    late_action: bool = True
    _target_: str = "torchrl_mpfa.make_critic"


@dataclass
class StochasticActorConfig(ActorConfig):
    """Configuration of :func:`~torchrl_mpfa.make_stochastic_actor`.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(StochasticActorConfig(observation_size=24, action_size=2)).out_keys
        ['preactivation', 'scale', 'action']
    """

    _target_: str = "torchrl_mpfa.make_stochastic_actor"


@dataclass
class SignalLossConfig(LossConfig):
    """What the configurations of the losses share; see :class:`~torchrl_mpfa.losses.SignalLoss`."""

    actor_network: Any = None
    gamma: float = 0.99
    signals: list[str] = field(default_factory=lambda: list(DEFAULT_SIGNALS))
    gradient_order: float = 2.0
    importance: str = "critic"
    reward_scale: float = 1.0
    saturation_penalty: float = 0.0
    saturation_limit: float = 1.5
    target_average: int = 1
    pal_alpha: float = 0.4
    loss_function: str = "l2"
    separate_losses: bool = False
    reduction: str | None = None
    _convert_: str = "all"


@dataclass
class SignalDDPGLossConfig(SignalLossConfig):
    """Configuration of :class:`~torchrl_mpfa.SignalDDPGLoss`, with the one-step target.

    Without networks it is instantiated with ``_partial_=True``: the trainer adds them.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(SignalDDPGLossConfig(_partial_=True)).keywords["importance"]
        'critic'
    """

    value_network: Any = None
    delay_actor: bool = True
    delay_value: bool = True
    action_spec: Any = None
    bounds: list[float] | None = None
    policy_noise: float = 0.0
    noise_clip: float = 0.5
    _target_: str = "torchrl_mpfa.configs.learning._make_ddpg_loss"


@dataclass
class TwinCriticsConfig(SignalLossConfig):
    """What the configurations of the losses with several critics share."""

    qvalue_network: Any = None
    action_spec: Any = None
    num_qvalue_nets: int = 2
    delay_qvalue: bool = True
    deactivate_vmap: bool = False


@dataclass
class SignalTD3LossConfig(TwinCriticsConfig):
    """Configuration of :class:`~torchrl_mpfa.SignalTD3Loss`, with the one-step target.

    ``TD3Trainer`` wants ``_partial_=True``, and adds networks and the range of the actions.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(SignalTD3LossConfig(_partial_=True)).keywords["policy_noise"]
        0.2
    """

    bounds: list[float] | None = None
    policy_noise: float = 0.2
    noise_clip: float = 0.5
    delay_actor: bool = True
    _target_: str = "torchrl_mpfa.configs.learning._make_td3_loss"


@dataclass
class SignalSACLossConfig(TwinCriticsConfig):
    """Configuration of :class:`~torchrl_mpfa.SignalSACLoss`, with the one-step target.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(SignalSACLossConfig(_partial_=True)).keywords["target_entropy"]
        'auto'
    """

    alpha_init: float = 1.0
    min_alpha: float | None = None
    max_alpha: float | None = None
    fixed_alpha: bool = False
    target_entropy: str | float = "auto"
    scalar_output_mode: str | None = None
    _target_: str = "torchrl_mpfa.configs.learning._make_sac_loss"


@dataclass
class PriorityStepperConfig(HookConfig):
    """Configuration of :class:`~torchrl_mpfa.trainer.PriorityStepper`, for a trainer's ``hooks``.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(PriorityStepperConfig()).priority_updates
        0
    """

    stepper: Any = None
    _target_: str = "torchrl_mpfa.trainer.PriorityStepper"


@dataclass
class PriorityGuardConfig(HookConfig):
    """Configuration of :class:`~torchrl_mpfa.trainer.PriorityGuard`, for a trainer's ``hooks``.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(PriorityGuardConfig()).state_dict()
        {}
    """

    _target_: str = "torchrl_mpfa.trainer.PriorityGuard"


def _make_ddpg_loss(*, actor_network: Any, value_network: Any, **kwargs: Any) -> SignalDDPGLoss:
    return make_ddpg_loss(actor_network, value_network, **kwargs)


def _make_td3_loss(*, actor_network: Any, qvalue_network: Any, **kwargs: Any) -> SignalTD3Loss:
    return make_td3_loss(actor_network, qvalue_network, **kwargs)


def _make_sac_loss(*, actor_network: Any, qvalue_network: Any, **kwargs: Any) -> SignalSACLoss:
    return make_sac_loss(actor_network, qvalue_network, **kwargs)
