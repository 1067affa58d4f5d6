"""Learner of a training run, put together from its settings, and if its update is compiled."""

from __future__ import annotations

import os
import shutil
import sysconfig
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import torch
import torch._inductor.config as inductor
from tensordict.nn import TensorDictModule
from torch import Tensor
from tqdm import tqdm

from mpfa_envs.policies.layers import Choice, Layer, Table, from_torch
from mpfa_envs.robots.discrete import WHEEL_PAIRS
from mpfa_envs.sensing.observation import Binning
from torchrl_mpfa import (
    DQN,
    ActorCritic,
    Learner,
    make_actor,
    make_critic,
    make_stochastic_actor,
    make_value_network,
)
from torchrl_mpfa.methods import Method, Prioritized, loss_options
from torchrl_mpfa.networks import DirectModule, StochasticActor
from torchrl_mpfa.networks.deterministic import ValueNetwork
from training.run.q_learning import TabularQLearner, ValueTable, make_value_table
from training.settings.learners import LearnerSettings, is_discrete
from training.settings.train import TrainSettings

Options = dict[str, Any]


def make_learner(
    settings: LearnerSettings,
    method: Method,
    observation_size: int,
    action_size: int,
    *,
    device: str = "cpu",
    compile: bool = False,
) -> Learner:
    """Networks and learner, which writes those signals that the method asks for."""
    if settings.algorithm == "q_learning":
        return _q_learning(settings, method, observation_size, action_size)
    network: Options = {
        "width": settings.width,
        "layers": settings.layers,
        "layer_norm": settings.layer_norm,
        "final_init": settings.final_init,
    }
    sizes = observation_size, action_size
    if settings.algorithm == "dqn":
        return _dqn(settings, method, make_value_network(*sizes, **network).to(device))
    critic = make_critic(*sizes, late_action=settings.late_action, **network)
    make = make_stochastic_actor if settings.algorithm == "sac" else make_actor
    limit = settings.saturation_limit
    actor = make(*sizes, **network, saturation_limit=limit if settings.full_range else None)
    algorithm = settings.algorithm
    of_algorithm: dict[str, Options] = {
        "ddpg": {"critics": 1, "policy_delay": settings.policy_delay},
        "td3": {"critics": 2, "policy_delay": settings.policy_delay},
        "sac": {"alpha": settings.alpha_init, "alpha_lr": settings.alpha_lr},
    }
    if algorithm != "sac":
        of_algorithm[algorithm] |= {
            # Wheel speeds are scaled to it by the environment.
            "bounds": (-1.0, 1.0),
            "policy_noise": settings.policy_noise,
            "noise_clip": settings.noise_clip,
        }
    kind: type[ActorCritic] = resolve_name(method.learner)
    return kind(
        actor.to(device),
        critic.to(device),
        **of_algorithm[algorithm],
        **loss_options(method),
        gamma=settings.gamma,
        reward_scale=settings.reward_scale,
        saturation_penalty=settings.saturation_penalty,
        saturation_limit=settings.saturation_limit,
        actor_lr=settings.actor_lr,
        critic_lr=settings.critic_lr,
        critic_weight_decay=settings.critic_weight_decay,
        tau=settings.tau,
        compile=compile,
    )


def _dqn(settings: LearnerSettings, method: Method, network: DirectModule) -> Learner:
    options = loss_options(method)
    return DQN(
        network,
        **{name: options[name] for name in ("signals", "importance", "loss_function")},
        double=settings.double,
        gamma=settings.gamma,
        reward_scale=settings.reward_scale,
        lr=settings.critic_lr,
        weight_decay=settings.critic_weight_decay,
        tau=settings.tau,
    )


@dataclass(frozen=True)
class Cells:
    """The cells of a binning, of tensors."""

    binning: Binning

    def __call__(self, observation: Tensor) -> Tensor:
        """From observations, shape ``[..., O]``, to numbers of cells, shape ``[...]``."""
        return torch.from_numpy(np.asarray(self.binning(observation.cpu().numpy())))


def _q_learning(
    settings: LearnerSettings, method: Method, observation_size: int, actions: int
) -> Learner:
    cells = Cells(Binning(observation_size=observation_size))
    return TabularQLearner(
        make_value_table(cells, cells.binning.cells, actions),
        lr=settings.table_lr,
        gamma=settings.gamma,
        importance=method.importance != "none",
    )


def method_of(settings: TrainSettings) -> Method:
    """The method of a run; where actions are choices, without the action gradient."""
    method = settings.method
    if not is_discrete(settings.learner) or not isinstance(method, Prioritized):
        return method
    return replace(method, signals=[s for s in method.signals if s != "action_gradient"])


def policy_layers(policy: TensorDictModule) -> list[Layer]:
    """The layers of a policy, from observation to the action without noise."""
    choice = Choice(np.array(WHEEL_PAIRS, dtype=np.float32))
    module = getattr(policy, "module", None)
    if isinstance(module, ValueNetwork):
        return [*from_torch(module.layers()), choice]
    if isinstance(module, ValueTable):
        cells = module.cell_of
        assert isinstance(cells, Cells)
        return [Table(module.table.numpy().copy(), **asdict(cells.binning)), choice]
    network = policy if isinstance(policy, StochasticActor) else policy.module
    return from_torch(network.layers())


_MANY_UPDATES = 5_000
"""From here on a program saves more than it takes to make one."""
_EPISODE = 100
"""Actions that an episode is counted as, of a run whose stages count episodes."""


def is_compiled(settings: TrainSettings) -> bool:
    """Return True if the update is compiled: as asked for, or by the length of the run alone.

    So a seed gives the same bits whatever was compiled before.
    """
    wanted = settings.learner.compile
    if wanted != "auto":
        return bool(wanted)
    stages = settings.curriculum.stages
    actions = sum(stage.actions + _EPISODE * stage.episodes for stage in stages)
    long = actions // settings.robots * settings.updates >= _MANY_UPDATES
    if not long or is_discrete(settings.learner):
        return False
    if not has_compiler():
        tqdm.write("updates take twice as long: there is no C++ compiler, or no headers of Python")
        return False
    return True


def has_compiler() -> bool:
    """Return True if there are a C++ compiler and the headers of Python."""
    headers = Path(sysconfig.get_path("include"), "Python.h")
    return headers.exists() and shutil.which(os.environ.get("CXX", "g++")) is not None


def prepare_compiler() -> None:
    """Set PyTorch's compiler for a few small programs on a CPU."""
    # Threads wait for the C++ compiler. Further processes, to compile programs of a GPU, would
    # be started for nothing.
    os.environ.setdefault("TORCH_WARM_POOL", "0")
    # It need not compile a program for each set of vector instructions that the processor has, a
    # quarter of the time: a compiler that takes PyTorch's C++20 knows them.
    if inductor.cpp.vec_isa_ok is None:
        inductor.cpp.vec_isa_ok = True
