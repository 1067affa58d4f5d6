"""Hydra configurations of samplers, storages and buffer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from torchrl.trainers.algorithms.configs import (
    LazyMemmapStorageConfig,
    LazyTensorStorageConfig,
    TensorDictReplayBufferConfig,
)
from torchrl.trainers.algorithms.configs.data import SamplerConfig

from torchrl_mpfa.samplers.mpfa import MPFASampler
from torchrl_mpfa.samplers.signal_sampler import SignalSampler
from torchrl_mpfa.signals import MPFA_SIGNALS, Signal
from torchrl_mpfa.storages import SignalMemmapStorage, SignalTensorStorage


def _mpfa_signals() -> list[Any]:
    return [signal.name for signal in MPFA_SIGNALS]


@dataclass
class SignalSamplerConfig(SamplerConfig):
    """Configuration of :class:`~torchrl_mpfa.SignalSampler`; by default PER, by the TD error alone.

    The capacity is that of the ``storage`` beside the sampler, wherever the two groups are placed.
    Signals are names, or configurations of :class:`~torchrl_mpfa.Signal`; fusion and adjustments
    are configurations, such as ``{_target_: torchrl_mpfa.PositiveBoost, boost: 2.0}``.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(SignalSamplerConfig(max_capacity=100)).fusion
        FixedFusion(values={'td_error': 1.0})
    """

    max_capacity: Any = "${..storage.max_size}"
    alpha: float = 0.6
    beta: float = 0.4
    eps: float = 1e-8
    reduction: str = "max"
    max_priority_within_buffer: bool = False
    device: Any = "cpu"
    signals: list[Any] = field(default_factory=lambda: ["td_error"])
    fusion: Any = None
    adjustments: list[Any] | None = field(default_factory=list)
    entropy_refresh: float = 1 / 256
    stratified: bool = False
    combination: str = "sum"
    _target_: str = "torchrl_mpfa.configs.replay._make_signal_sampler"
    _convert_: str = "all"


@dataclass
class MPFASamplerConfig(SignalSamplerConfig):
    """Configuration of :class:`~torchrl_mpfa.MPFASampler`, with the paper's choices.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(MPFASamplerConfig(max_capacity=100)).max_size
        100
    """

    eps: float = 0.05
    max_priority_within_buffer: bool = True
    signals: list[Any] = field(default_factory=_mpfa_signals)
    adjustments: list[Any] | None = None
    positive_above: Any = 0.0
    _target_: str = "torchrl_mpfa.configs.replay._make_mpfa_sampler"


@dataclass
class SignalTensorStorageConfig(LazyTensorStorageConfig):
    """Configuration of :class:`~torchrl_mpfa.SignalTensorStorage`.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(SignalTensorStorageConfig(max_size=100)).max_size
        100
    """

    signals: list[Any] = field(default_factory=_mpfa_signals)
    reward_key: Any = ("next", "reward")
    allow_nonfinite: list[Any] = field(default_factory=list)
    _target_: str = "torchrl_mpfa.configs.replay._make_tensor_storage"
    _convert_: str = "all"


@dataclass
class SignalMemmapStorageConfig(LazyMemmapStorageConfig):
    """Configuration of :class:`~torchrl_mpfa.SignalMemmapStorage`.

    Examples:
        >>> from hydra.utils import instantiate
        >>> instantiate(SignalMemmapStorageConfig(max_size=100)).max_size
        100
    """

    signals: list[Any] = field(default_factory=_mpfa_signals)
    reward_key: Any = ("next", "reward")
    allow_nonfinite: list[Any] = field(default_factory=list)
    _target_: str = "torchrl_mpfa.configs.replay._make_memmap_storage"
    _convert_: str = "all"


@dataclass
class SignalReplayBufferConfig(TensorDictReplayBufferConfig):
    """Configuration of :class:`~torchrl_mpfa.SignalReplayBuffer`.

    Examples:
        >>> from hydra.utils import instantiate
        >>> made = instantiate(
        ...     SignalReplayBufferConfig(
        ...         sampler=MPFASamplerConfig(),
        ...         storage=SignalTensorStorageConfig(max_size=100),
        ...         batch_size=8,
        ...     )
        ... )
        >>> made.sampler.max_size
        100
    """

    _target_: str = "torchrl_mpfa.SignalReplayBuffer"


def _make_signal_sampler(*, signals: Sequence[Any], **kwargs: Any) -> SignalSampler:
    return SignalSampler(signals=_signals(signals), **kwargs)


def _make_mpfa_sampler(*, signals: Sequence[Any], **kwargs: Any) -> MPFASampler:
    return MPFASampler(signals=_signals(signals), **kwargs)


def _make_tensor_storage(**options: Any) -> SignalTensorStorage:
    return SignalTensorStorage(**_with_keys(**options))


def _make_memmap_storage(**options: Any) -> SignalMemmapStorage:
    return SignalMemmapStorage(**_with_keys(**options))


def _with_keys(
    *, signals: Sequence[Any], reward_key: Any, allow_nonfinite: Sequence[Any], **others: Any
) -> dict[str, Any]:
    """Options of a storage, with nested keys where a configuration has lists."""
    return {
        "signals": _signals(signals),
        "reward_key": _key(reward_key),
        "allow_nonfinite": [_key(key) for key in allow_nonfinite],
        **others,
    }


def _key(key: Any) -> Any:
    """A nested key out of the list that a configuration has for it."""
    return tuple(key) if isinstance(key, list) else key


def _signals(signals: Sequence[Any]) -> list[Signal | str]:
    """Signals whose keys are nested keys."""
    return [replace(s, key=_key(s.key)) if isinstance(s, Signal) else s for s in signals]
