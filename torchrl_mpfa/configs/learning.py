"""Hydra configurations of networks, losses and trainer hooks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torchrl.trainers.algorithms.configs.hooks import HookConfig
from torchrl.trainers.algorithms.configs.modules import NetworkConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig

from torchrl_mpfa.losses import SignalDDPGLoss, SignalTD3Loss, make_ddpg_loss, make_td3_loss


@dataclass
class ActorConfig(NetworkConfig):
    """Configuration of :func:`~torchrl_mpfa.make_actor`.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(ActorConfig(observation_size=24, action_size=2)).out_keys
        ['preactivation', 'action']
    """

    observation_size: Any = "???"
    action_size: Any = "???"
    width: int = 256
    layers: int = 2
    layer_norm: bool = True
    final_init: float | None = 3e-3
    _target_: str = "torchrl_mpfa.make_actor"


@dataclass
class CriticConfig(ActorConfig):
    """Configuration of :func:`~torchrl_mpfa.make_critic`.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(CriticConfig(observation_size=24, action_size=2)).out_keys
        ['state_action_value']
    """

    late_action: bool = True
    _target_: str = "torchrl_mpfa.make_critic"


@dataclass
class SignalLossConfig(LossConfig):
    """What the configurations of the losses share; see :class:`~torchrl_mpfa.SignalDDPGLoss`."""

    actor_network: Any = None
    gamma: float = 0.99
    signals: list[str] = field(default_factory=lambda: ["td_error", "action_gradient"])
    gradient_order: float = 2.0
    gradient_at: str = "stored"
    importance: str = "critic"
    reward_scale: float = 1.0
    saturation_penalty: float = 0.0
    saturation_limit: float = 1.5
    loss_function: str = "l2"
    delay_actor: bool = True
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
    delay_value: bool = True
    _target_: str = "torchrl_mpfa.configs.learning._make_ddpg_loss"


@dataclass
class SignalTD3LossConfig(SignalLossConfig):
    """Configuration of :class:`~torchrl_mpfa.SignalTD3Loss`, with the one-step target.

    ``TD3Trainer`` wants ``_partial_=True``, and adds networks and the range of the actions.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(SignalTD3LossConfig(_partial_=True)).keywords["policy_noise"]
        0.2
    """

    qvalue_network: Any = None
    action_spec: Any = None
    bounds: list[float] | None = None
    num_qvalue_nets: int = 2
    policy_noise: float = 0.2
    noise_clip: float = 0.5
    delay_qvalue: bool = True
    deactivate_vmap: bool = False
    _target_: str = "torchrl_mpfa.configs.learning._make_td3_loss"


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
    # TorchRL's loss takes one of the two, and reads a None as given.
    for name in ("action_spec", "bounds"):
        if kwargs.get(name) is None:
            kwargs.pop(name, None)
    return make_td3_loss(actor_network, qvalue_network, **kwargs)
