"""Where transitions come from: an environment and how it is explored, here or in a second process.

In a second process the robot drives while the networks learn. The two go hand in hand, so that a
run can be repeated and resumed to the bit: action t is chosen by the policy that was updated after
transition t - 2, where a serial run has the one updated after t - 1. TorchRL's collectors in
processes of their own send batches of many steps, or let the policy be as old as it happens to be.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from environments import INFO, make_training_env
from exploration import Explorer, make_explorer
from process import Companion
from settings import TrainSettings
from torchrl_mpfa import DirectModule
from torchrl_mpfa.stochastic import StochasticActor

TRANSITION = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)
"""What a buffer keeps of a step."""


@dataclass(frozen=True)
class Start:
    """How an episode begins."""

    world: str
    """Map or world file."""
    seed: int
    """Seed of the environment and of the noise."""
    step: int
    """Actions before it, of which the first ones of a run are random."""


class Collector(Protocol):
    """The episodes of a run, transition by transition."""

    def begin(self, start: Start, explorer: Explorer) -> None:
        """Begin an episode, explored by this."""
        ...

    def collect(self) -> TensorDictBase:
        """Give the next transition, the entries of :data:`TRANSITION`, batch size ``[1]``."""
        ...

    def proceed(self) -> None:
        """Let the next action be chosen; the episode goes on."""
        ...

    def info(self) -> dict[str, Any]:
        """Entries of the environment's info at the end of an episode."""
        ...

    def close(self) -> None:
        """Release the environment."""
        ...


class LocalCollector:
    """Drives in this process, when a transition is asked for.

    Args:
        settings: Of the run.
        device: Where the policy is.
    """

    def __init__(self, settings: TrainSettings, *, device: str) -> None:
        self.settings = settings
        self.device = device
        self._env: EnvBase | None = None
        self._world = ""

    def environment(self, world: str) -> EnvBase:
        """The environment of a map, kept for as long as the map stays the same."""
        if self._env is None or world != self._world:
            self.close()
            self._env = make_training_env(world, self.settings.environment)
            self._world = world
        return self._env

    def begin(self, start: Start, explorer: Explorer) -> None:
        """Begin an episode, explored by this."""
        env = self.environment(start.world)
        env.set_seed(start.seed)
        torch.manual_seed(start.seed)
        explorer.begin_episode()
        self._explorer, self._step = explorer, start.step
        self._state = env.reset()

    def collect(self) -> TensorDictBase:
        """Choose an action and drive."""
        assert self._env is not None
        state = self._env.step(self._act(self._env, self._state))
        self._step += 1
        self._last, self._state = state["next"], step_mdp(state)
        return state.select(*TRANSITION).unsqueeze(0)

    @torch.no_grad()
    def _act(self, env: EnvBase, state: TensorDictBase) -> TensorDictBase:
        if self._step < self.settings.exploration.random_steps:
            return env.rand_action(state)
        observation = state.get("observation").to(self.device)
        return state.set("action", self._explorer.act(observation).cpu())

    def proceed(self) -> None:
        """Nothing to do: the action is chosen when its transition is asked for."""

    def info(self) -> dict[str, Any]:
        """Entries of the environment's info at the end of an episode."""
        return {name: self._last["info", name].item() for name in INFO}

    def close(self) -> None:
        """Release the environment."""
        if self._env is not None:
            self._env.close()
            self._env = None


class RemoteCollector:
    """Drives in a second process, while this one learns.

    The explorer in this process, which a method may ask how much noise there is, is as it was at
    the end of the episode before.

    Args:
        settings: Of the run.
        policy: The policy; what acts is a copy of it in shared memory.
        example: What a step of the environment looks like.

    Raises:
        RuntimeError: By any method, if the second process failed, with its error.
    """

    def __init__(
        self, settings: TrainSettings, policy: nn.Module, *, example: TensorDictBase
    ) -> None:
        self._slot = example.select(*TRANSITION).unsqueeze(0).contiguous().share_memory_()
        acting = copy.deepcopy(policy).to("cpu").share_memory()
        self._theirs = list(acting.parameters())
        self._companion = Companion("environment", _drive, settings, acting, self._slot)

    def begin(self, start: Start, explorer: Explorer) -> None:
        """Begin an episode, explored by this."""
        self._explorer = explorer
        self._ours = list(explorer.policy.parameters())
        self._publish()
        self._companion.send((start, explorer.state_dict()))

    def collect(self) -> TensorDictBase:
        """Wait for the transition."""
        end = self._companion.receive()
        if end is not None:
            self._info, state = end
            self._explorer.load_state_dict(state)
        return self._slot.clone()

    def proceed(self) -> None:
        """Let the next action be chosen by the policy as it is now."""
        self._publish()
        self._companion.send(None)

    def info(self) -> dict[str, Any]:
        """Entries of the environment's info at the end of an episode."""
        return self._info

    def close(self) -> None:
        """End the second process."""
        self._companion.close()

    @torch.no_grad()
    def _publish(self) -> None:
        for theirs, ours in zip(self._theirs, self._ours, strict=True):
            theirs.copy_(ours)


def _drive(
    connection: Connection,
    settings: TrainSettings,
    policy: DirectModule | StochasticActor,
    slot: TensorDictBase,
) -> None:
    """Serve a :class:`RemoteCollector`: told how an episode begins, or that it may go on."""
    collector = LocalCollector(settings, device="cpu")
    explorer: Explorer | None = None
    try:
        while True:
            message = connection.recv()
            if message is not None:
                start, state = message
                if explorer is None:
                    spec = collector.environment(start.world).action_spec
                    explorer = make_explorer(policy, settings.exploration, spec)
                explorer.load_state_dict(state)
                collector.begin(start, explorer)
            assert explorer is not None
            transition = collector.collect()
            slot.update_(transition)
            over = transition["next", "done"].item()
            connection.send((collector.info(), explorer.state_dict()) if over else None)
    finally:
        collector.close()
