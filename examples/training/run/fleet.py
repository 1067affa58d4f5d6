"""Robots on a Ray cluster, driven by TorchRL's collectors, which write in a remote buffer."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import timedelta
from functools import partial
from typing import Any

import numpy as np
import ray
import torch
from ray.exceptions import RayActorError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase, InitTracker, TransformedEnv
from torchrl.weight_update import _ray
from tqdm import tqdm

from torchrl_mpfa.integrations.ray import RaySignalReplayBuffer, make_ray_replay
from torchrl_mpfa.methods import Method, Replay
from training.environments import FilteredRobots, make_training_env
from training.records import EpisodeRecord
from training.run.driving import TRANSITION, Robots
from training.run.exploration import Explorer, make_explorer
from training.settings.learners import is_discrete
from training.settings.train import TrainSettings

# Learner and workers meet in a process of its own before weights are sent, for which TorchRL waits
# one minute. On a loaded machine it takes longer to start.
_ray._DIST_TIMEOUT = timedelta(minutes=5)
_ENDLESS = 2**62
"""Of -1 actions TorchRL's Ray collector, other than its documentation says, collects none."""
_MOST_LOSSES = 3
"""Times that workers may be lost one after the other without a word from any of them."""


class ExploringPolicy(TensorDictModuleBase):
    """A policy that explores, sent to workers by its weights.

    Args:
        policy: What it explores around.
        settings: Of the run.
        action_spec: Of the robots of a worker, shape ``[N, A]``.
    """

    def __init__(self, policy: nn.Module, settings: TrainSettings, action_spec: TensorSpec) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["observation", "is_init"], ["action"]
        self.policy = policy
        self.register_buffer("actions", torch.zeros((), dtype=torch.long))
        self._settings, self._spec = settings.exploration, action_spec
        self._filter = FilteredRobots(settings)
        self._explorer = make_explorer(policy, self._settings, action_spec)  # type: ignore[arg-type]

    def follow(self, policy: nn.Module, actions: int) -> None:
        """Copy the weights of a policy, and the number of actions of the run so far."""
        self.policy.load_state_dict(policy.state_dict())
        self.actions.fill_(actions)

    @torch.no_grad()
    def forward(self, state: TensorDictBase) -> TensorDictBase:
        """Write actions, shape ``[N, A]``."""
        begun = state["is_init"].squeeze(-1)
        if begun.any():
            self._explorer.begin_episodes(begun)
        steps = int(self.actions) - self._settings.random_steps
        if steps < 0:
            return self._filter(state.set("action", self._spec.rand()))
        self._explorer.move_to(steps)
        state.set("action", self._explorer.act(state["observation"]))
        return self._filter(state)


class RobotCollector(Collector):
    """TorchRL's collector in a worker: writes transitions, and reports rewards and ends to the run.

    Args:
        *args: Of :class:`~torchrl.collectors.Collector`.
        replay_buffer: Where they are written.
        **kwargs: Of :class:`~torchrl.collectors.Collector`.
    """

    def __init__(self, *args: Any, replay_buffer: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._writes_to = replay_buffer

    def next(self) -> TensorDictBase:
        """Drive ``T`` actions with each of ``N`` robots.

        Returns:
            Batch size ``[N, T]``: ``reward``, ``done`` and ``info`` of each action, its ``slot`` in
            the buffer, and the number of the ``worker``.
        """
        data = super().next()
        slots = self._writes_to.extend(data.select(*TRANSITION).reshape(-1))
        report: TensorDictBase = data["next"].select("reward", "done", "info")
        report.set("slot", slots.reshape(data.shape))
        return report.set("worker", torch.full(data.shape, self.worker_idx))


class Fleet(Robots):
    """The robots of a run, in equal parts on the workers of a Ray cluster.

    A lost worker is replaced: all workers are restarted, which costs the episodes in progress, as
    the connections by which TorchRL sends weights have their members for life.

    Args:
        settings: Of the run.
    """

    def __init__(self, settings: TrainSettings) -> None:
        super().__init__(settings)
        self._each = settings.robots // settings.ray.workers
        self._owns_ray = not ray.is_initialized()
        if self._owns_ray:
            ray.init(
                settings.ray.address,
                include_dashboard=False,
                log_to_driver=False,
                configure_logging=False,
                runtime_env=_with_plugin(settings.plugin),
            )
        self._collector: Any = None
        self._reports: Iterator[TensorDictBase] = iter(())
        self._buffer: RaySignalReplayBuffer | None = None
        self._seed, self._launches = 0, 0
        self.losses = 0
        """Times that a worker was lost."""

    def make_replay(self, method: Method, *, seed: int, **policy: Any) -> Replay:
        """See :meth:`Robots.make_replay`; the buffer is on this machine, in its own process."""
        self._stop_workers()
        if self._buffer is not None:
            self._buffer.shutdown()
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        config = {"num_cpus": 0, "scheduling_strategy": here}
        replay = make_ray_replay(method, seed=seed, remote_config=config, **policy)
        self._buffer = replay.buffer
        return replay

    def environment(self, world: str) -> EnvBase:
        """The environment of a worker, for its specs."""
        if self._env is None or world != self._world:
            self._env = _make_env(self.settings, self._each, world)
            self._world = world
        return self._env

    def begin(self, world: str, explorer: Explorer, *, seed: int) -> None:
        """See :meth:`Robots.begin`."""
        self._stop_workers()
        self.environment(world)
        self._seed = seed
        self._give_up(explorer)

    def _begin_episodes(self, begun: Tensor, explorer: Explorer) -> None:
        """Number the episodes; the policies of the workers see for themselves that they begin."""
        count = int(begun.sum())
        self._numbers[begun, 0] = torch.arange(self._begun, self._begun + count)
        self._begun += count

    def drive(
        self, explorer: Explorer, *, actions: int, episode: int, entries: Sequence[NestedKey] = ()
    ) -> tuple[TensorDictBase, list[EpisodeRecord]]:
        """Take the actions of the worker that is ready first, or of all, in order, with ``sync``.

        Returns:
            ``("next", "reward")`` and ``slot`` of the transitions, which are in the buffer, batch
            size ``[B]``, and the records of the episodes that ended.
        """
        explorer.move_to(max(actions - self.settings.exploration.random_steps, 0))
        report = self._report(explorer, actions)
        parts = report.unbind(0) if self.settings.ray.sync else [report]
        records: list[EpisodeRecord] = []
        for part in parts:
            robots = int(part["worker"][0, 0]) * self._each + torch.arange(self._each)
            for step in range(part.shape[1]):
                records += self._note(
                    part[:, step],
                    robots,
                    explorer,
                    episode=episode + len(records),
                    total_steps=actions + report.numel(),
                )
        rows = {
            "next": {"reward": report["reward"].reshape(-1, 1)},
            "slot": report["slot"].flatten(),
        }
        return TensorDict(rows, [report.numel()]), records

    def _report(self, explorer: Explorer, actions: int) -> TensorDictBase:
        """Return the report of a worker; restart the workers if one is lost."""
        for _ in range(_MOST_LOSSES):
            try:
                if self._collector is None:
                    self._start_workers(explorer, actions)
                self._policy.follow(explorer.policy, actions)
                return next(self._reports)
            except RayTaskError:
                raise  # An error in a worker, or its buffer is gone.
            except (RayActorError, RuntimeError) as error:
                # Weights that cannot be sent to a worker are a RuntimeError of PyTorch.
                began = not getattr(error, "actor_init_failed", False)
                if not began or (not isinstance(error, RayActorError) and self._all_alive()):
                    raise
                self.losses += 1
                tqdm.write("a worker is gone: the robots begin new episodes on others")
                self._stop_workers()
                self._give_up(explorer)
        raise RuntimeError(f"workers were lost {_MOST_LOSSES} times in a row")

    def _all_alive(self) -> bool:
        collector = self._collector
        return collector is not None and collector.stats()["workers_alive"] == len(
            collector.remote_collectors
        )

    def _start_workers(self, explorer: Explorer, actions: int) -> None:
        assert self._buffer is not None and self._world is not None
        workers, sync = self.settings.ray.workers, self.settings.ray.sync
        policy = copy.deepcopy(explorer.policy).cpu()
        spec = self.environment(self._world).action_spec
        self._policy = ExploringPolicy(policy, self.settings, spec)
        self._policy.follow(explorer.policy, actions)
        self._launches += 1
        seeds = np.random.SeedSequence([self._seed, self._launches]).generate_state(workers)
        make = partial(_make_worker_env, self.settings, self._each, self._world)
        frames = self.settings.ray.steps * (self.count if sync else self._each)
        self._collector = Collector(
            [partial(make, int(seed)) for seed in seeds],
            self._policy,
            backend="ray",
            num_collectors=workers,
            sync=sync,
            frames_per_batch=frames,
            total_frames=_ENDLESS,
            backend_options={
                "collector_class": RobotCollector,
                "replay_buffer": self._buffer,
                "remote_configs": {"num_cpus": 1, "scheduling_strategy": "SPREAD"},
                "update_after_each_batch": True,
            },
        )
        self._collector.update_policy_weights_(self._policy)
        self._reports = self._collector.iterator()

    def _stop_workers(self) -> None:
        collector, self._collector = self._collector, None
        if collector is not None:
            with suppress(Exception):  # Those that are gone cannot say goodbye.
                collector.shutdown()

    def state_dict(self) -> dict[str, Any]:
        """Return which episodes are in progress; the places of the robots stay on the workers."""
        return {"environment": None, **self._counts()}

    def can_go_on(self, state: dict[str, Any]) -> bool:
        """Return False: the robots begin new episodes."""
        return False

    def close(self) -> None:
        """Stop the workers and the buffer."""
        self._stop_workers()
        if self._buffer is not None:
            self._buffer.shutdown()
            self._buffer = None
        super().close()
        if self._owns_ray:
            ray.shutdown()


def _with_plugin(plugin: str | None) -> dict[str, Any]:
    """Return what Ray needs so that its processes load a plugin first."""
    if plugin is None:
        return {}
    from training.plugins import load_plugin

    def load() -> None:
        load_plugin(plugin)

    return {"worker_process_setup_hook": load}


def _make_env(settings: TrainSettings, robots: int, world: str) -> EnvBase:
    discrete = is_discrete(settings.learner)
    return make_training_env(world, settings.environment, robots=robots, discrete=discrete)


def _make_worker_env(settings: TrainSettings, robots: int, world: str, seed: int) -> EnvBase:
    """Make the environment of a worker, whose process gets the same seed."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    env = _make_env(settings, robots, world)
    env.set_seed(seed)
    return TransformedEnv(env, InitTracker())
