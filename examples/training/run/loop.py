"""The training run: iterations of many robots at once, with checkpoints at any of them."""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from tqdm import tqdm

from mpfa_envs import GoalRelabeling, Policy, RandomMirror, save_policy
from mpfa_envs.robots.discrete import WHEEL_PAIRS
from torchrl_mpfa import run_updates
from torchrl_mpfa.methods.her import HindsightGoals
from torchrl_mpfa.saving import save_atomically, write_text_atomically
from torchrl_mpfa.selection import SampledBatch
from training import files
from training.environments import vector_of
from training.records import (
    AssessmentRecord,
    EpisodeRecord,
    EvaluationRecord,
    as_table,
    last_best,
    write_table,
)
from training.run.assembly import make_curiosity, make_learner, make_robots, method_of
from training.run.assessment import Assessment
from training.run.checkpoints import FORMAT, random_state, set_random_state
from training.run.compiling import is_compiled
from training.run.evaluations import evaluate_policy, exported_policy
from training.run.exploration import make_explorer
from training.run.schedule import Schedule
from training.run.showing import show_policy
from training.run.tracking import Tracker
from training.run.updates import UpdateLog
from training.settings.learners import is_discrete
from training.settings.train import TrainSettings
from training.stopping import Stop

_RECENT = 100
"""Episodes whose success is shown."""
_MANY_EPISODES = 500
"""From here on the learning rates fall linearly unless the settings say otherwise."""
_TELL_EVERY = 1.0
"""Between two words on how far the run is [s]."""


class TrainingRun:
    """Everything that a run is: its parts, how far it is, and its records.

    An iteration is one action of each robot, and the updates that are due for them.

    Args:
        settings: The settings.
        folder: Where checkpoints and records go.
        state: A checkpoint to go on with.
    """

    def __init__(
        self, settings: TrainSettings, folder: Path, state: dict[str, Any] | None = None
    ) -> None:
        self.settings = settings
        self.folder = folder
        self.schedule = Schedule(settings.curriculum.stages)
        self.stop = Stop()
        torch.manual_seed(settings.seed)
        self.robots = make_robots(settings)
        env = self.robots.environment(self.schedule.world)
        self._action_spec = env.action_spec
        self._observation_size = env.observation_spec["observation"].shape[-1]
        robots = vector_of(env)
        self._task = robots.config
        self._remembered: dict[str, Any] = {
            "sectors": robots.lidar.sectors,
            "memory": robots.config.memory,
            "history": robots.config.history,
        }
        capacity, scale = settings.method.capacity, settings.learner.reward_scale
        self.log = UpdateLog(capacity, reward_scale=scale)
        self._build()
        self.updates = 0
        self._waiting = 0
        """Actions whose updates are still to be made."""
        self.records: list[EpisodeRecord] = []
        self.evaluations: list[EvaluationRecord] = []
        self.assessments: list[AssessmentRecord] = []
        self._bonus: dict[str, Tensor] = {}
        self._best: TensorDictModule | None = None
        """The policy that did best in the evaluations."""
        self._told = 0.0
        if state is None:
            self._begin_stage()
        else:
            self._load(state)
        run_id = None if state is None else state["wandb"]
        self.tracker = Tracker(settings, folder, run_id=run_id, actions=self.actions)

    def _build(self) -> None:
        """Make the parts that learn, and the buffer."""
        settings, spec = self.settings, self._action_spec
        sizes = self._observation_size, spec.shape[-1]
        method, device = method_of(settings), settings.device
        self._to_compile = is_compiled(settings)
        self.learner = make_learner(
            settings.learner, method, *sizes, device=device, compile=self._to_compile
        )
        self.curiosity = make_curiosity(method, *sizes, device=device)
        self.explorer = make_explorer(self.learner.policy, settings.exploration, spec)
        replay = self.robots.make_replay(
            method,
            seed=settings.seed,
            policy=self.learner.policy,
            sigma=lambda: self.explorer.sigma,
        )
        self._replay, self.buffer = replay, replay.buffer
        self.select = replay.select
        self.entries: tuple[NestedKey, ...] = replay.entries
        self.log.forget(method.capacity)
        wanted = settings.assessment
        self.assessment = Assessment(wanted) if wanted.episodes else None
        if method.hindsight:
            relabel = GoalRelabeling(self._task)
            goals = HindsightGoals(
                relabel, goals=method.hindsight, strategy=method.hindsight_strategy
            )
            self.buffer.append_transform(goals)
            self.entries += relabel.entries
        if settings.environment.mirror:
            pairs = WHEEL_PAIRS if is_discrete(settings.learner) else None
            self.buffer.append_transform(RandomMirror(**self._remembered, pairs=pairs))

    def _begin_stage(self, *, again: int = 0) -> None:
        seed = self.settings.seed * 1_000_003 + self.schedule.stage + again
        # However many random numbers the parts were made of, the robots explore alike.
        torch.manual_seed(seed)
        self.robots.begin(self.schedule.world, self.explorer, seed=seed)
        if self.assessment is not None:
            self.assessment.begin_stage()
        self._hold()

    # Iterations ------------------------------------------------------------------------------

    @property
    def actions(self) -> int:
        """Actions of all robots so far."""
        return self.schedule.actions

    def train(self, on_iteration: Callable[[], object] | None = None) -> bool:
        """Run to the end of the curriculum, or until asked to stop.

        Whatever ends it, the run is saved as it is then, unless an error broke its parts.
        """
        bar = tqdm(
            total=self.schedule.total,
            initial=self.schedule.done,
            unit=self.schedule.unit,
            smoothing=0.05,
        )
        begun = self.actions
        with self.stop.listening(), bar:
            try:
                while not self.schedule.finished and not self.stop:
                    before = self.actions
                    self._iterate()
                    bar.update(self.schedule.done - bar.n)
                    if time.monotonic() - self._told > _TELL_EVERY:
                        bar.set_postfix_str(self._tell())
                    if self._crossed(self.settings.checkpoint_every, before):
                        self.save()
                    if on_iteration is not None:
                        on_iteration()
            except Exception:
                if self._is_sound():
                    self.save()
                raise
            bar.set_postfix_str(self._summary())
        self.save()
        # Whoever reads that a run is finished may remove its checkpoint.
        self._tell(saved=True)
        if self.schedule.finished and self.actions > begun:
            self._show()
        return self.schedule.finished

    def _iterate(self) -> None:
        """One action of each robot, and the updates for them."""
        before = self.actions
        rows, records = self.robots.drive(
            self.explorer,
            actions=before,
            episode=self.schedule.episodes,
            entries=self.entries,
        )
        # Robots on other machines have written theirs.
        slots = rows.get("slot", None)
        slots = self.buffer.extend(rows) if slots is None else slots
        self.log.wrote(slots, rows["next", "reward"])
        self.records += records
        self.schedule.count(actions=len(rows), episodes=len(records))
        self._assess(records)
        if len(self.buffer) >= (self.buffer.batch_size or 0):
            self._waiting += len(rows)
            self._update(before)
        self._hold()
        if self._crossed(self.settings.tracking.log_every, before):
            self.log.add(self.actions, episode=self.schedule.episodes, buffer=self.buffer)
        for record in records:
            self.learner.end_episode()
            self.tracker.log_episode(record)
        if self._crossed(self.settings.evaluation.every, before):
            self._evaluate()
        if self._crossed(self.settings.tracking.pictures_every or 0, before):
            self._show()
        # Last: a run that an error ends before here begins the stage when it goes on.
        self._advance()
        self._anneal()

    def _advance(self) -> bool:
        """Begin the next stage if it is due, and tell whether it was."""
        if not self.schedule.advance():
            return False
        if not self.settings.curriculum.carry:
            self._build()
            self._waiting = 0
        self._begin_stage()
        return True

    def _crossed(self, every: int, before: int) -> bool:
        """Whether a multiple of so many actions lies between those before and those now."""
        return every > 0 and before // every != self.actions // every

    def _hold(self) -> None:
        """Have whole episodes assess the policy as it is, from when it is what acts."""
        assessment, schedule = self.assessment, self.schedule
        acts = self.actions >= self.settings.exploration.random_steps
        if assessment is not None and assessment.over and acts:
            assessment.begin(
                self.robots.next_episode,
                late=schedule.fraction >= self.settings.assessment.early_share,
                at=(schedule.episodes, schedule.actions),
            )

    def _assess(self, records: list[EpisodeRecord]) -> None:
        """Score the episodes that ended, and keep the policy if all of them have ended well."""
        assessment = self.assessment
        if assessment is None or assessment.over:
            return
        for number, record in zip(self.robots.ended, records, strict=True):
            assessment.take(number, assessment.score(record))
        if assessment.over:
            found = assessment.conclude(
                self.learner.policy, total_steps=self.actions, episode=self.schedule.episodes
            )
            self.assessments.append(found)
            self.tracker.log_assessment(found)

    def _update(self, before: int) -> None:
        """The updates that are due: of this iteration, or all since the policy was held."""
        block, assessment = self.settings.method.update_block, self.assessment
        due, left = divmod(self._waiting, self.settings.robots)
        if not due or not (self._crossed(block, before) if assessment is None else assessment.over):
            return
        begun, updates = self.actions - self._waiting, self.settings.updates
        if self.settings.ray.workers:
            # A call to another process costs as much as an update: one for all that are due.
            due, updates = 1, due * updates
        if self._to_compile:
            self._to_compile = False
            tqdm.write("compiling the update, some 20 s, or a few if that was done before")
        for _ in range(due):
            losses, batch = run_updates(
                self.buffer,
                self.learner,
                self.select,
                updates=updates,
                prepare=self._prepared,
            )
            self.updates += updates
        self._waiting = left
        self.log.learned(losses)
        if self._crossed(self.settings.tracking.log_every, begun):
            self.tracker.log_update(self.actions, {**losses, **self._bonus}, self.buffer, batch)

    def _prepared(self, draw: SampledBatch) -> SampledBatch:
        """A draw where the networks are, with the bonus of curiosity in its rewards."""
        device = self.settings.device
        if draw.gives_signals:
            self.log.learns(draw.batch["index"])
        if device != "cpu":
            draw = replace(draw, batch=draw.batch.to(device))
        if self.curiosity is not None and draw.gives_signals:
            self._bonus = self.curiosity(draw.batch)
        return draw

    def _evaluate(self) -> None:
        kept = None if self.assessment is None else self.assessment.kept
        policy = self.learner.policy if kept is None else kept
        found = evaluate_policy(
            self.settings,
            policy,
            total_steps=self.actions,
            episode=self.schedule.episodes,
            trained_for=self.robots.elapsed(),
        )
        # The clock of the run shows how long it trains.
        self.robots.seconds -= found.seconds
        if found.is_best(self.evaluations):
            self._best = copy.deepcopy(policy)
        self.evaluations.append(found)
        self.tracker.log_evaluation(found)

    def _show(self) -> None:
        """Log what the policy of the run does in the worlds of the evaluations."""
        seconds = show_policy(
            self.tracker,
            self.settings,
            self._exported(),
            self.learner,
            folder=self.folder,
            actions=self.actions,
        )
        # As of an evaluation.
        self.robots.seconds -= seconds

    def _anneal(self) -> None:
        """Move what changes with the run: beta of Eq. (10), fusion and learning rates."""
        settings, done = self.settings, self.schedule.fraction
        self._replay.anneal(done)
        lowest, power = settings.learner.lr_end_factor, settings.learner.lr_power
        if power is None:
            few = self.schedule.unit == "episode" and self.schedule.total < _MANY_EPISODES
            power = 3.0 if few else 1.0
        self.learner.anneal(lowest + (1.0 - lowest) * (1.0 - done) ** power)

    def _summary(self) -> str:
        """How it goes, in a few words."""
        speed = f"{self.updates / max(self.robots.elapsed(), 1e-9):.0f} updates/s"
        recent = self.records[-_RECENT:]
        if not recent:
            return f"no episode yet, {speed}"
        success = sum(record.success for record in recent) / len(recent)
        return f"{recent[-1].world}: success {success:.0%} of last {len(recent)}, {speed}"

    def _tell(self, *, saved: bool = False) -> str:
        """Say how far the run is, to whoever reads its folder, and in a few words."""
        self._told, summary = time.monotonic(), self._summary()
        status = {
            "unit": self.schedule.unit,
            "done": self.schedule.done,
            "total": self.schedule.total,
            "episodes": self.schedule.episodes,
            "steps": self.actions,
            "summary": summary,
            "given_up": self.robots.given_up,
            "finished": self.schedule.finished and saved,
        }
        write_text_atomically(json.dumps(status), self.folder / files.STATUS)
        return summary

    # Saving ----------------------------------------------------------------------------------

    def _is_sound(self) -> bool:
        """Whether an error has left the networks as numbers."""
        weights = self.learner.state_dict()["loss"].values()
        return all(bool(value.isfinite().all()) for value in weights)

    def save(self) -> None:
        """Write checkpoint, policy and records, each of them whole or not at all."""
        # What was logged until now is not logged again by a run that goes on from here.
        self.tracker.flush()
        state = {
            "format": FORMAT,
            "settings": asdict(self.settings),
            "wandb": self.tracker.run_id,
            "schedule": self.schedule.state_dict(),
            "updates": self.updates,
            "waiting": self._waiting // self.settings.robots,
            "waiting_actions": self._waiting % self.settings.robots,
            "random": random_state(self.settings.device),
            "robots": self.robots.state_dict(),
            "learner": self.learner.state_dict(),
            "buffer": self.buffer.state_dict(),
            "explorer": self.explorer.state_dict(),
            "curiosity": None if self.curiosity is None else self.curiosity.checkpoint(),
            "best": None if self._best is None else dict(self._best.state_dict()),
            "records": [asdict(record) for record in self.records],
            "evaluations": [asdict(record) for record in self.evaluations],
            "assessments": [asdict(record) for record in self.assessments],
            "assessment": None if self.assessment is None else self.assessment.state_dict(),
            "log": self.log.state_dict(),
        }
        save_atomically(state, self.folder / files.CHECKPOINT)
        save_policy(self._exported(), self.folder / files.POLICY, overwrite=True)
        write_table(as_table(self.records, EpisodeRecord), self.folder / files.EPISODES)
        if self.evaluations:
            table = as_table(self.evaluations, EvaluationRecord)
            write_table(table, self.folder / files.EVALUATIONS)
        if self.assessments:
            table = as_table(self.assessments, AssessmentRecord)
            write_table(table, self.folder / files.ASSESSMENTS)
        write_table(self.log.table(), self.folder / files.UPDATES)

    def _exported(self) -> Policy:
        """The policy of the run: the last one, that which did best, or that which was kept."""
        policy, episodes, steps = self.learner.policy, self.schedule.episodes, self.actions
        if self.settings.evaluation.choose and self._best is not None:
            record = last_best(self.evaluations)
            policy, episodes, steps = self._best, record.episode, record.total_steps
        if self.assessment is not None and self.assessment.kept is not None:
            policy, (episodes, steps) = self.assessment.kept, self.assessment.kept_at
        return exported_policy(policy, self.settings, episodes=episodes, steps=steps)

    def _load(self, state: dict[str, Any]) -> None:
        """Go on where a checkpoint was written."""
        self.schedule.load_state_dict(state["schedule"])
        self.updates = state["updates"]
        self._waiting = state.get("waiting", 0) * self.settings.robots
        self._waiting += state.get("waiting_actions", 0)
        self.learner.load_state_dict(state["learner"])
        self.buffer.load_state_dict(state["buffer"])
        self.explorer.load_state_dict(state["explorer"])
        if self.curiosity is not None:
            self.curiosity.restore(state["curiosity"])
        if state["best"] is not None:
            self._best = copy.deepcopy(self.learner.policy)
            self._best.load_state_dict(state["best"])
        self.records = [EpisodeRecord(**record) for record in state["records"]]
        self.evaluations = [EvaluationRecord(**record) for record in state["evaluations"]]
        if self.assessment is not None:
            self.assessments = [AssessmentRecord(**record) for record in state["assessments"]]
            self.assessment.load_state_dict(state["assessment"], self.learner.policy)
        if "log" in state:  # A checkpoint may be older than the rows.
            self.log.load_state_dict(state["log"])
        set_random_state(self.settings.device, state["random"])
        self.robots.recall(state["robots"])
        if self._advance():
            pass
        elif self.robots.can_go_on(state["robots"]):
            self.robots.load_state_dict(self.schedule.world, state["robots"])
            set_random_state(self.settings.device, state["random"])
        else:
            self._begin_stage(again=self.actions)
        self._anneal()

    def close(self) -> None:
        """Release the simulation and finish the log."""
        self.robots.close()
        self.tracker.close()
