"""Hydra configurations of the replay parts, for TorchRL's own groups.

TorchRL composes trainers out of groups of configurations (``torchrl.trainers.algorithms.configs``).
:func:`register_configs` adds those of this package to them: ``sampler=mpfa``,
``storage=signal_tensor``, ``replay_buffer=signal``, ``loss=signal_ddpg``. A whole method is one
entry: ``replay_buffer=signal_mpfa_per`` is its buffer, and ``replay=la3p``, in a group of this
package, is the result of :func:`~torchrl_mpfa.methods.make_replay`, with the selection that LA3P
and KLPER need. Hydra is needed by this module alone.

Configurations are made from signatures: every argument is a field with the same default.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import field, fields, make_dataclass, replace
from functools import partial
from typing import Any, Optional, get_type_hints

from torchrl.trainers.algorithms.configs import (
    ConfigStore,
    LazyMemmapStorageConfig,
    LazyTensorStorageConfig,
    TensorDictReplayBufferConfig,
)
from torchrl.trainers.algorithms.configs.data import ReplayBufferBaseConfig, SamplerConfig
from torchrl.trainers.algorithms.configs.hooks import HookConfig
from torchrl.trainers.algorithms.configs.modules import NetworkConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig

from torchrl_mpfa.buffer import SignalReplayBuffer
from torchrl_mpfa.integrations.trainer import PriorityStepper
from torchrl_mpfa.losses import (
    SignalDDPGLoss,
    SignalSACLoss,
    SignalTD3Loss,
    make_ddpg_loss,
    make_sac_loss,
    make_td3_loss,
)
from torchrl_mpfa.methods import METHODS, Replay, make_replay
from torchrl_mpfa.networks import make_actor, make_critic, make_stochastic_actor
from torchrl_mpfa.samplers import MPFASampler, SignalSampler
from torchrl_mpfa.signals import MPFA_SIGNALS, Signal
from torchrl_mpfa.storages import SignalMemmapStorage, SignalTensorStorage

_HERE = "torchrl_mpfa.integrations.hydra"
_STARS = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
_PLAIN = {"bool": bool, "int": int, "float": float, "str": str}
_BESIDE = {"storage": None, "device": "auto", "policy": None, "sigma": None, "generator": None}
"""Arguments of :func:`~torchrl_mpfa.methods.make_replay` other than settings."""


# Functions that Hydra calls.


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
    """Make a loss of networks that have other names in the function that makes it."""
    critic = qvalue_network if value_network is None else value_network
    return made(actor_network, critic, **options)


def _make_replay(name: str, **settings: Any) -> Replay:
    return make_replay(name, **settings)


def _make_buffer(name: str, **settings: Any) -> SignalReplayBuffer:
    return make_replay(name, **settings).buffer


make_signal_sampler = partial(_with_keys, SignalSampler)
make_mpfa_sampler = partial(_with_keys, MPFASampler)
make_tensor_storage = partial(_with_keys, SignalTensorStorage)
make_memmap_storage = partial(_with_keys, SignalMemmapStorage)
make_ddpg = partial(_loss, make_ddpg_loss)
make_td3 = partial(_loss, make_td3_loss)
make_sac = partial(_loss, make_sac_loss)


# From signatures to configurations.


def config_of(
    made: Any,
    base: type,
    target: str,
    *,
    name: str = "",
    required: Any = "???",
    leave_out: Collection[str] = (),
    **defaults: Any,
) -> type[Any]:
    """Make a configuration of a class, with the arguments that it passes on, or of a function.

    The fields of ``base``, a configuration of TorchRL, stay as they are. Hydra calls ``target``;
    ``required`` is the default of arguments that have none.
    """
    known = {each.name for each in fields(base)} | set(leave_out)
    entries: dict[str, tuple[str, Any, Any]] = {}
    for parameter in _parameters(made):
        if parameter.name in known and parameter.name not in defaults:
            continue
        default = required if parameter.default is parameter.empty else parameter.default
        default = defaults.get(parameter.name, default)
        kind = _type_of(parameter.annotation)
        # An interpolation, or a word that stands for a number.
        kind = Any if isinstance(default, str) and kind is not str else kind
        entries.setdefault(parameter.name, (parameter.name, kind, _field_default(default)))
    title = name or f"{made.__name__}Config"
    doc = f"Configuration of ``{made.__name__}``, which describes the fields."
    return _dataclass(title, list(entries.values()), base, target, doc)


def _config_of_method(name: str, target: str) -> type[Any]:
    """Make a configuration with the settings of a method as defaults."""
    method = METHODS[name]
    hints = get_type_hints(type(method))
    entries: list[tuple[str, Any, Any]] = []
    for setting in fields(method):
        value = name if setting.name == "name" else getattr(method, setting.name)
        entries.append((setting.name, hints[setting.name], _field_default(value)))
    entries += [(word, Any, default) for word, default in _BESIDE.items()]
    title = "".join(part.capitalize() for part in name.split("_"))
    kind = type(method).__name__
    doc = f"Configuration of the method ``{name}``; see :class:`{kind}` for its settings."
    return _dataclass(f"{title}Config", entries, ReplayBufferBaseConfig, f"{_HERE}.{target}", doc)


def _dataclass(title: str, entries: list[Any], base: type, target: str, doc: str) -> type[Any]:
    path = [("_target_", str, target), ("_convert_", str, "all")]
    made = make_dataclass(title, [*entries, *path], bases=(base,))
    made.__doc__, made.__module__ = doc, __name__
    return made


def _field_default(value: Any) -> Any:
    """Return a default as a configuration can hold it: a new list for each sequence."""
    if not isinstance(value, list | tuple):
        return value
    plain = [each.name if isinstance(each, Signal) else each for each in value]
    return field(default_factory=lambda: list(plain))


def _parameters(made: Any) -> Iterator[inspect.Parameter]:
    """Yield the parameters of a function, or of a class and of those that get its keywords."""
    functions = [made]
    if inspect.isclass(made):
        functions = [vars(each)["__init__"] for each in made.__mro__ if "__init__" in vars(each)]
    for function in functions:
        parameters = inspect.signature(function).parameters.values()
        yield from (p for p in parameters if p.name != "self" and p.kind not in _STARS)
        if all(p.kind is not p.VAR_KEYWORD for p in parameters):
            return


def _type_of(annotation: Any) -> Any:
    """Return a type that Hydra checks, or any value."""
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", "")
    plain = _PLAIN.get(text.removesuffix(" | None"))
    if plain is None:
        return Any
    return Optional[plain] if text.endswith("None") else plain  # noqa: UP045


# The capacity is that of the storage in the same group. A type is no value of a configuration.
# Signals are names or configurations of Signal; fusion and adjustments are configurations.
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
_network_config = partial(config_of, base=NetworkConfig)
ActorConfig = _network_config(make_actor, target="torchrl_mpfa.make_actor", name="ActorConfig")
CriticConfig = _network_config(make_critic, target="torchrl_mpfa.make_critic", name="CriticConfig")
StochasticActorConfig = _network_config(
    make_stochastic_actor,
    target="torchrl_mpfa.make_stochastic_actor",
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
    **{("replay", name): _config_of_method(name, "_make_replay") for name in METHODS},
    **{
        ("replay_buffer", f"signal_{name}"): _config_of_method(name, "_make_buffer")
        for name, method in METHODS.items()
        if method.plain
    },
}
"""The configurations by group, TorchRL's or ``replay``, and by name: every method in the group
``replay``, and as a buffer those that sample one batch a step."""


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
