"""Replay whose priority is fused from several signals, as TorchRL parts."""

from typing import TYPE_CHECKING, Any

from torchrl_mpfa.lazy import find

if TYPE_CHECKING:
    from torchrl_mpfa.adjustment import Adjustment as Adjustment
    from torchrl_mpfa.adjustment import PositiveBoost as PositiveBoost
    from torchrl_mpfa.adjustment import PositiveDecay as PositiveDecay
    from torchrl_mpfa.buffer import SignalReplayBuffer as SignalReplayBuffer
    from torchrl_mpfa.exploration import GaussianNoise as GaussianNoise
    from torchrl_mpfa.fusion import EntropyFusion as EntropyFusion
    from torchrl_mpfa.fusion import FixedFusion as FixedFusion
    from torchrl_mpfa.fusion import Fusion as Fusion
    from torchrl_mpfa.fusion import ScaledFusion as ScaledFusion
    from torchrl_mpfa.learners import DQN as DQN
    from torchrl_mpfa.learners import ActorCritic as ActorCritic
    from torchrl_mpfa.learners import Learner as Learner
    from torchrl_mpfa.losses import write_signals as write_signals
    from torchrl_mpfa.methods import METHODS as METHODS
    from torchrl_mpfa.methods import make_replay as make_replay
    from torchrl_mpfa.networks import make_actor as make_actor
    from torchrl_mpfa.networks import make_critic as make_critic
    from torchrl_mpfa.networks import make_stochastic_actor as make_stochastic_actor
    from torchrl_mpfa.networks import make_value_network as make_value_network
    from torchrl_mpfa.samplers import MPFASampler as MPFASampler
    from torchrl_mpfa.samplers import SignalSampler as SignalSampler
    from torchrl_mpfa.samplers import SignalSliceSampler as SignalSliceSampler
    from torchrl_mpfa.signals import ACTION_GRADIENT as ACTION_GRADIENT
    from torchrl_mpfa.signals import MPFA_SIGNALS as MPFA_SIGNALS
    from torchrl_mpfa.signals import REWARD as REWARD
    from torchrl_mpfa.signals import TD_ERROR as TD_ERROR
    from torchrl_mpfa.signals import Signal as Signal
    from torchrl_mpfa.stopping import Stop as Stop
    from torchrl_mpfa.storages import SignalMemmapStorage as SignalMemmapStorage
    from torchrl_mpfa.storages import SignalTensorStorage as SignalTensorStorage
    from torchrl_mpfa.updates import run_updates as run_updates

__version__ = "0.5.0"

_NAMES = {
    "adjustment": "Adjustment PositiveBoost PositiveDecay",
    "buffer": "SignalReplayBuffer",
    "exploration": "GaussianNoise",
    "fusion": "EntropyFusion FixedFusion Fusion ScaledFusion",
    "learners": "DQN ActorCritic Learner",
    "losses": "write_signals",
    "methods": "METHODS make_replay",
    "networks": "make_actor make_critic make_stochastic_actor make_value_network",
    "samplers": "MPFASampler SignalSampler SignalSliceSampler",
    "signals": "ACTION_GRADIENT MPFA_SIGNALS REWARD TD_ERROR Signal",
    "stopping": "Stop",
    "storages": "SignalMemmapStorage SignalTensorStorage",
    "updates": "run_updates",
}
"""Public names by module. A module is imported when a name of it is first used, as TorchRL's
buffers take half a second, for which a command's help need not wait."""
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted(_MODULE_OF, key=lambda name: (not name.isupper(), name))


def __getattr__(name: str) -> Any:
    """Import a name when it is first used."""
    return find(__name__, name, _MODULE_OF)
