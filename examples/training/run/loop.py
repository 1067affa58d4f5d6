"""One life of a run: set up, iterate (collect, update, evaluate), save, load, close."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from tqdm import tqdm

from mpfa_envs import GoalRelabeling, save_policy
from mpfa_envs.robots.discrete import WHEEL_PAIRS
from torchrl_mpfa import Stop, run_updates
from torchrl_mpfa.methods import OwnSignals, make_replay
from torchrl_mpfa.methods.assembly import learned_signals
from torchrl_mpfa.methods.her import HindsightGoals
from torchrl_mpfa.saving import save_atomically
from torchrl_mpfa.selection import SampledBatch
from training import files
from training.environments import vector_of
from training.evaluating import Drives
from training.records import EpisodeRecord, EvaluationRecord, as_table, write_table
from training.run import tracking
from training.run.assembly import is_compiled, make_learner, method_of
from training.run.checkpoints import FORMAT, is_sound, random_state, set_random_state
from training.run.driving import Robots
from training.run.evaluations import evaluate_policy, kept_policy
from training.run.exploration import make_explorer
from training.run.hooks import Checkpoints, Hook, Progress
from training.run.schedule import Schedule
from training.run.updates import UpdateLog
from training.settings.learners import is_discrete
from training.settings.train import TrainSettings

_MANY_EPISODES = 500
"""From here on the learning rates fall linearly unless the settings say otherwise."""


class TrainingRun:
    """Everything that a run is: its parts, how far it is, and its records.

    An iteration is one action of each robot, and the updates that are due for them.

    Args:
        settings: The settings.
        folder: Where checkpoints and records go.
        state: A checkpoint to resume from.
        hooks: Hooks to call after the run's own hooks.

    Raises:
        TypeError: If one of the hooks is no :class:`Hook`, or a class instead of an object.
    """

    def __init__(
        self,
        settings: TrainSettings,
        folder: Path,
        state: dict[str, Any] | None = None,
        hooks: Sequence[Hook] = (),
    ) -> None:
        for hook in hooks:
            if not isinstance(hook, Hook):
                raise TypeError(f"hooks: {hook!r} is no object of a class derived from Hook")
        self.settings = settings
        self.folder = folder
        self.schedule = Schedule(settings.curriculum.stages)
        self.stop = Stop(write=tqdm.write)
        torch.manual_seed(settings.seed)
        self.robots = Robots(settings)
        env = self.robots.environment(self.schedule.world)
        self._action_spec = env.action_spec
        self._observation_size = env.observation_spec["observation"].shape[-1]
        self._task = vector_of(env).config
        capacity, scale = settings.method.capacity, settings.learner.reward_scale
        self.log = UpdateLog(capacity, reward_scale=scale)
        self._build()
        self.updates = 0
        self.waiting = 0
        """Iterations whose updates are still to be made."""
        self._events: list[tuple[Any, ...]] = []
        """Events of the iteration that hooks still have to get."""
        self.records: list[EpisodeRecord] = []
        self.evaluations: list[EvaluationRecord] = []
        self.driven: Drives | None = None
        """Episodes of the last evaluation."""
        self._bonus: dict[str, Tensor] = {}
        self.best: TensorDictModule | None = None
        """The policy that did best in the evaluations."""
        if state is None:
            self._begin_stage()
        else:
            self._load(state)
        self._before = self.actions
        """Actions before the last iteration."""
        run_id = None if state is None else state["wandb"]
        self.tracker = tracking.Tracker(settings, folder, run_id=run_id)
        self.hooks = [self.tracker, Checkpoints(), tracking.Pictures(), Progress(), *hooks]

    def _build(self) -> None:
        """Make the parts that learn, and the buffer."""
        settings, spec = self.settings, self._action_spec
        sizes = self._observation_size, spec.shape[-1]
        method, device = method_of(settings), settings.device
        self._to_compile = is_compiled(settings)
        self.learner = make_learner(
            settings.learner, method, *sizes, device=device, compile=self._to_compile
        )
        self.signals = OwnSignals(learned_signals(method))
        bonus = method.bonus(*sizes)
        self.bonus = None if bonus is None else bonus.to(device)
        self.explorer = make_explorer(self.learner.policy, settings.exploration, spec)
        replay = make_replay(
            method,
            generator=torch.Generator().manual_seed(settings.seed),
            policy=self.learner.policy,
            sigma=lambda: self.explorer.sigma,
        )
        self._replay, self.buffer = replay, replay.buffer
        self.select = replay.select
        self.entries: tuple[NestedKey, ...] = replay.entries
        self.log.forget(method.capacity)
        if method.hindsight:
            relabel = GoalRelabeling(self._task)
            self.buffer.append_transform(HindsightGoals(relabel, goals=method.hindsight))
            self.entries += relabel.entries
        if settings.environment.mirror:
            pairs = WHEEL_PAIRS if is_discrete(settings.learner) else None
            self.buffer.append_transform(self._task.make_mirror(pairs=pairs))

    def _begin_stage(self) -> None:
        seed = self.settings.seed * 1_000_003 + self.schedule.stage
        # However many random numbers the parts were made of, the robots explore alike.
        torch.manual_seed(seed)
        self.robots.begin(self.schedule.world, self.explorer, seed=seed)

    # Iterate: collect, update, evaluate --------------------------------------------------------

    @property
    def actions(self) -> int:
        """Actions of all robots so far."""
        return self.schedule.actions

    def crossed(self, every: int) -> bool:
        """Return True if the last iteration has reached a multiple of ``every`` actions."""
        return every > 0 and self._before // every != self.actions // every

    def train(self) -> bool:
        """Run to the end of the curriculum, or until asked to stop.

        Whatever ends it, the run is saved as it is then, unless an error broke its parts. After a
        full disk the checkpoint before counts: the logs of this iteration may not be whole.
        """
        with self.stop.listening():
            try:
                self._call(("on_begin",))
                while not self.schedule.finished and not self.stop:
                    self._iterate()
                    self._call(("on_iteration",))
            except Exception as error:
                if is_sound(self.learner) and files.no_room(error) is None:
                    self.save()
                raise
        self._call(("on_end",))
        return self.schedule.finished

    def _call(self, *events: tuple[Any, ...]) -> None:
        """Call all events of a hook, by name and with their arguments, then those of the next."""
        for hook in self.hooks:
            for name, *arguments in events:
                getattr(hook, name)(self, *arguments)

    def _iterate(self) -> None:
        """One action of each robot, and the updates for them."""
        self._before, self._events = self.actions, []
        records = self._collect()
        if len(self.buffer) >= (self.buffer.batch_size or 0):
            self.waiting += 1
            self._update()
        if self.crossed(self.settings.tracking.log_every):
            self.log.add(self.actions, episode=self.schedule.episodes, buffer=self.buffer)
        for record in records:
            self.learner.end_episode()
            self._events.append(("on_episode", record))
        if self.crossed(self.settings.evaluation.every):
            self._evaluate()
        # Only now: a run that a hook ends resumes as if it had been stopped.
        self._call(*self._events)
        if self.crossed(self.settings.tracking.pictures_every or 0):
            tracking.show_policy(self)
        # Last: a run that an error ends before here begins the stage when it resumes.
        self._advance()
        self._anneal()

    # Collect, update, evaluate -------------------------------------------------------------------

    def _collect(self) -> list[EpisodeRecord]:
        """One action of each robot, to the buffer; return the episodes that ended."""
        rows, records = self.robots.drive(
            self.explorer,
            actions=self._before,
            episode=self.schedule.episodes,
            entries=self.entries,
        )
        self.log.wrote(self.buffer.extend(rows), rows["next", "reward"])
        self.records += records
        self.schedule.count(actions=len(rows), episodes=len(records))
        return records

    def _update(self) -> None:
        """The updates that are due, of a block of actions together."""
        if not self.crossed(self.settings.method.update_block):
            return
        every = self.settings.tracking.log_every
        begun = self.actions - self.waiting * self.settings.robots
        if self._to_compile:
            self._to_compile = False
            tqdm.write("compiling the update, some 20 s, or a few if that was done before")
        for _ in range(self.waiting):
            losses, batch = run_updates(
                self.buffer,
                self.learner,
                self.select,
                updates=self.settings.updates,
                prepare=self._prepared,
            )
            self.updates += self.settings.updates
        self.waiting = 0
        self.log.learned(losses)
        if every > 0 and begun // every != self.actions // every:
            self._events.append(("on_update", {**losses, **self._bonus}, batch))

    def _prepared(self, sampled: SampledBatch) -> SampledBatch:
        """Move sampled batches to the networks, and add signals and bonuses of the run."""
        device = self.settings.device
        if sampled.gives_signals:
            for index in sampled.batch["index"].chunk(sampled.batches):
                self.log.learns(index)
        if device != "cpu":
            sampled = replace(sampled, batch=sampled.batch.to(device))
        if not sampled.gives_signals or (self.bonus is None and not self.signals):
            return sampled
        return sampled.each(self._extend)

    def _extend(self, batch: TensorDictBase) -> None:
        """Add the bonus and the signals of the run to a batch."""
        if self.bonus is not None:
            self._bonus = self.bonus(batch)
        self.signals.write(self.learner, batch)

    def _evaluate(self) -> None:
        found, self.driven = evaluate_policy(
            self.settings,
            self.learner.policy,
            total_steps=self.actions,
            episode=self.schedule.episodes,
            trained_for=self.robots.elapsed(),
        )
        # The clock of the run shows how long it trains.
        self.robots.seconds -= found.seconds
        if found.is_best(self.evaluations):
            self.best = copy.deepcopy(self.learner.policy)
        self.evaluations.append(found)
        self._events.append(("on_evaluation", found))

    # The next stage ------------------------------------------------------------------------------

    def _advance(self) -> bool:
        """Begin the next stage if it is due; return True if it was."""
        if not self.schedule.advance():
            return False
        if not self.settings.curriculum.carry:
            self._build()
            self.waiting = 0
        self._begin_stage()
        return True

    def _anneal(self) -> None:
        """Move what changes with the run: beta of Eq. (10), fusion and learning rates."""
        settings, done = self.settings, self.schedule.fraction
        self._replay.anneal(done)
        lowest, power = settings.learner.lr_end_factor, settings.learner.lr_power
        if power is None:
            few = self.schedule.unit == "episode" and self.schedule.total < _MANY_EPISODES
            power = 3.0 if few else 1.0
        self.learner.anneal(lowest + (1.0 - lowest) * (1.0 - done) ** power)

    # Save and load -------------------------------------------------------------------------------

    def save(self) -> None:
        """Write checkpoint, policy and records, each of them whole or not at all."""
        folder = self.folder
        # A run that resumes here does not log the same entries again.
        self.tracker.flush()
        save_atomically(self.state_dict(), folder / files.CHECKPOINT)
        save_policy(kept_policy(self), folder / files.POLICY, overwrite=True)
        write_table(as_table(self.records, EpisodeRecord), folder / files.EPISODES)
        if self.evaluations:
            write_table(as_table(self.evaluations, EvaluationRecord), folder / files.EVALUATIONS)
        write_table(self.log.table(), folder / files.UPDATES)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next iteration of a run depends on, and its records."""
        return {
            "format": FORMAT,
            "settings": asdict(self.settings),
            "wandb": self.tracker.run_id,
            "schedule": self.schedule.state_dict(),
            "updates": self.updates,
            "waiting": self.waiting,
            "random": random_state(self.settings.device),
            "robots": self.robots.state_dict(),
            "learner": self.learner.state_dict(),
            "buffer": self.buffer.state_dict(),
            "explorer": self.explorer.state_dict(),
            "curiosity": None if self.bonus is None else self.bonus.checkpoint(),
            "signals": self.signals.state_dict(),
            "plugin": files.digest_of(self.settings.plugin),
            "best": None if self.best is None else dict(self.best.state_dict()),
            "records": [asdict(record) for record in self.records],
            "evaluations": [asdict(record) for record in self.evaluations],
            "log": self.log.state_dict(),
        }

    def _load(self, state: dict[str, Any]) -> None:
        """Load a state of :meth:`state_dict`."""
        self.schedule.load_state_dict(state["schedule"])
        self.updates = state["updates"]
        self.waiting = state["waiting"]
        self.learner.load_state_dict(state["learner"])
        self.buffer.load_state_dict(state["buffer"])
        self.explorer.load_state_dict(state["explorer"])
        if self.bonus is not None:
            self.bonus.restore(state["curiosity"])
        self.signals.load_state_dict(state["signals"])
        if state["best"] is not None:
            self.best = copy.deepcopy(self.learner.policy)
            self.best.load_state_dict(state["best"])
        self.records = [EpisodeRecord(**record) for record in state["records"]]
        self.evaluations = [EvaluationRecord(**record) for record in state["evaluations"]]
        self.log.load_state_dict(state["log"])
        set_random_state(self.settings.device, state["random"])
        self.robots.recall(state["robots"])
        if not self._advance():
            self.robots.load_state_dict(self.schedule.world, state["robots"])
        # A run that has become longer is less far.
        self._anneal()

    def close(self) -> None:
        """Release the simulation and what the hooks hold."""
        with ExitStack() as parts:
            for hook in reversed(self.hooks):
                parts.callback(hook.close)
            parts.callback(self.robots.close)
