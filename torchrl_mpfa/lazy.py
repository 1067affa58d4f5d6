"""Names of a package that are imported when they are first used."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any

_ACTOR_CRITIC = (
    "torchrl_mpfa.ActorCritic(actor, critic), which holds its losses; "
    "or TorchRL's own loss and torchrl_mpfa.write_signals(batch, loss)"
)
_DQN = "torchrl_mpfa.DQN(network), which holds its loss"
GONE = {
    **dict.fromkeys(
        (
            *("SignalLoss", "SignalDDPGLoss", "SignalTD3Loss", "SignalSACLoss"),
            *("make_ddpg_loss", "make_td3_loss", "make_sac_loss"),
            *("ActorCriticLearner", "DDPGLearner", "TD3Learner", "SACLearner"),
        ),
        _ACTOR_CRITIC,
    ),
    "SignalDQNLoss": _DQN,
    "DQNLearner": _DQN,
    "MultiTensorSoftUpdate": "TorchRL's SoftUpdate: a learner moves its targets itself",
    "ReplayHistory": "examples/training/run/updates.py, or buffer.distributions() by yourself",
    **dict.fromkeys(
        ("TabularQLearner", "make_value_table"),
        "examples/training/run/q_learning.py, which train.py has for learner=q_learning",
    ),
    "hydra": "nothing: a Hydra file names each part as _target_",
    "SignalStorageMixin": "nothing: the sampler keeps the signals",
    "SignalTable": "torchrl_mpfa.samplers.SignalTable",
    **dict.fromkeys(
        ("check_adjustment", "check_fusion"),
        "torchrl_mpfa.testing.check_sampler, which checks a sampler with both",
    ),
}
"""Names of 0.4 that went, with what replaces them: docs/from_0_4.md has all."""


def find(package: str, name: str, module_of: Mapping[str, str]) -> Any:
    """Return a public name of a package from its module, or a module of the package."""
    if instead := GONE.get(name):
        # An AttributeError would lose its text in ``from package import name``.
        raise ImportError(f"{package}.{name} is no longer there since 0.5: use {instead}")
    if name in module_of:
        return getattr(import_module(f"{package}.{module_of[name]}"), name)
    # A module is an attribute of its package only once it was imported.
    if "__path__" in vars(sys.modules[package]) and find_spec(f"{package}.{name}"):
        return import_module(f"{package}.{name}")
    raise AttributeError(f"module {package!r} has no attribute {name!r}")
