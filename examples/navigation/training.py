"""The training run: episodes of the curriculum, one update a step, checkpoints between episodes."""

from __future__ import annotations

import copy
import json
import logging
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tqdm import tqdm

from mpfa_envs import RandomMirror, save_policy
from navigation import files
from navigation.assembly import make_curiosity, make_learner
from navigation.checkpoints import FORMAT
from navigation.driving import Driver
from navigation.evaluating import evaluate_policy, exported_policy
from navigation.exploration import make_explorer
from navigation.records import EpisodeRecord, EvaluationRecord, as_table, write_table
from navigation.settings import Stage, TrainSettings
from navigation.stopping import Stop
from navigation.tracking import Tracker
from torchrl_mpfa import SignalSampler, save_atomically
from torchrl_mpfa.methods import make_replay
from torchrl_mpfa.saving import write_text_atomically

_RECENT = 20
_MANY_EPISODES = 500
"""From here on the learning rates fall linearly unless the settings say otherwise."""


@dataclass(frozen=True)
class Moment:
    """A run between two episodes: what the next one depends on."""

    episode: int
    step: int
    parts: dict[str, Any]
    policy: TensorDictModule


class TrainingRun:
    """Everything that a run is: its parts, how far it is, and its records.

    Randomness starts anew with each episode, from the seed of the run and the number of the
    episode, so that a run which was stopped between two episodes goes on as if it had not been.

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
        self.stages: list[Stage] = list(settings.curriculum.stages)
        self.total_episodes = sum(stage.episodes for stage in self.stages)
        self.stop = Stop()
        torch.manual_seed(settings.seed)
        self.driver = Driver(settings)
        env = self.driver.environment(self.stages[0].world)
        self._action_spec = env.action_spec
        self._observation_size = env.observation_spec["observation"].shape[-1]
        self._build()
        self._waiting: list[TensorDictBase] = []
        self.episode = 0
        self.step = 0
        self.records: list[EpisodeRecord] = []
        self.evaluations: list[EvaluationRecord] = []
        if state is not None:
            self._load(state)
        self.tracker = Tracker(settings, folder, run_id=None if state is None else state["wandb"])
        # Should an episode fail, its networks and its buffer are not to be saved.
        self._kept = copy.deepcopy(self._moment())

    def _build(self) -> None:
        """Make the parts that learn, and the buffer."""
        settings, spec = self.settings, self._action_spec
        sizes = self._observation_size, spec.shape[-1]
        method, device = settings.method, settings.device
        generator = torch.Generator().manual_seed(settings.seed)
        self.learner = make_learner(settings.learner, method, *sizes, device=device)
        self.curiosity = make_curiosity(method, *sizes, device=device)
        self.explorer = make_explorer(self.learner.policy, settings.exploration, spec)
        replay = make_replay(
            method,
            generator=generator,
            policy=self.learner.policy,
            sigma=lambda: self.explorer.sigma,
        )
        self.buffer, self.select = replay.buffer, replay.select
        if settings.environment.mirror:
            self.buffer.append_transform(RandomMirror())

    # Episodes --------------------------------------------------------------------------------

    def train(self, on_episode: Callable[[EpisodeRecord], None] | None = None) -> bool:
        """Run to the end of the curriculum, or until asked to stop.

        Whatever ends it, the last finished episode is saved.

        Args:
            on_episode: Called with the record of each finished episode.

        Returns:
            Whether the curriculum was finished.
        """
        bar = tqdm(total=self.total_episodes, initial=self.episode, unit="episode", smoothing=0.05)
        with self.stop.listening(), bar:
            try:
                while self.episode < self.total_episodes and not self.stop:
                    self._finish(self._run_episode())
                    bar.update()
                    bar.set_postfix_str(self._summary())
                    if self.episode % self.settings.checkpoint_every == 0:
                        self.save()
                    if on_episode is not None:
                        on_episode(self.records[-1])
            except BaseException:
                self._write(self._kept)
                raise
            self.save()
        finished = self.episode == self.total_episodes
        self._tell(finished=finished)
        return finished

    def _finish(self, record: EpisodeRecord) -> None:
        """Count an episode, log it, and evaluate if that fell due."""
        self.records.append(record)
        self.episode += 1
        self.tracker.log_episode(record)
        every = self.settings.evaluation.every
        if every > 0 and self.step // every != (self.step - record.steps) // every:
            found = evaluate_policy(
                self.settings, self.learner.policy, total_steps=self.step, episode=self.episode
            )
            self.evaluations.append(found)
            self.tracker.log_evaluation(found)
        self._kept = copy.deepcopy(self._moment())
        self._tell()

    def _summary(self) -> str:
        recent = self.records[-_RECENT:]
        if not recent:
            return "no episode yet"
        success = sum(r.success for r in recent) / len(recent)
        return f"world {recent[-1].world}, success {success:.0%} of last {len(recent)}"

    def _tell(self, *, finished: bool = False) -> None:
        """Say how far the run is, to whoever reads its folder."""
        status = {
            "episode": self.episode,
            "episodes": self.total_episodes,
            "steps": self.step,
            "summary": self._summary(),
            "finished": finished,
        }
        write_text_atomically(json.dumps(status), self.folder / files.STATUS)

    def _stage(self, episode: int) -> Stage:
        for stage in self.stages:
            if episode < stage.episodes:
                return stage
            episode -= stage.episodes
        return self.stages[-1]

    def _begins_stage(self) -> bool:
        """Whether the next episode is the first one in a world, but for the first world."""
        lengths = [stage.episodes for stage in self.stages]
        return self.episode in list(accumulate(lengths))[:-1]

    def _run_episode(self) -> EpisodeRecord:
        seed = episode_seed(self.settings.seed, self.episode)
        torch.manual_seed(seed)
        if not self.settings.curriculum.carry and self._begins_stage():
            self._build()
        self._anneal()
        world = self._stage(self.episode).world
        start, total_reward, steps = time.perf_counter(), 0.0, 0
        self.driver.begin(world, self.explorer, seed=seed, step=self.step)
        done = False
        while not done:
            transition = self.driver.drive()
            self.step += 1
            steps += 1
            after = transition["next"]
            total_reward += after["reward"].item()
            done = after["done"].item()
            self._store(transition, flush=done)
            if self.step % self.settings.learner.update_every == 0:
                self._update()
        self.learner.end_episode()
        return EpisodeRecord(
            episode=self.episode,
            world=world,
            steps=steps,
            total_steps=self.step,
            reward=total_reward,
            average_reward=total_reward / steps,
            seconds=time.perf_counter() - start,
            **self.driver.info(),
        )

    def _store(self, transition: TensorDictBase, *, flush: bool) -> None:
        """Keep a step; those between two updates are written together, at the price of one."""
        self._waiting.append(transition)
        if flush or self.step % self.settings.learner.update_every == 0:
            first, *more = self._waiting
            # Most often there is one alone.
            self.buffer.extend(torch.cat(self._waiting) if more else first)
            self._waiting.clear()

    def _update(self) -> None:
        if len(self.buffer) < self.settings.method.batch_size:
            return
        device = self.settings.device
        values: dict[str, torch.Tensor] = {}
        for draw in self.select(self.buffer):
            if device != "cpu":
                draw = replace(draw, batch=draw.batch.to(device))
            # Rewards are the critic's business.
            if self.curiosity is not None and draw.gives_signals:
                values.update(self.curiosity(draw.batch))
            values.update(self.learner.update(draw))
            if draw.gives_signals:
                batch = draw.batch if device == "cpu" else draw.batch.to("cpu")
                self.buffer.update_tensordict_priority(batch)
        if self.step % self.settings.tracking.log_every == 0:
            self.tracker.log_update(self.step, values, self.buffer, batch)

    def _anneal(self) -> None:
        """Move what changes with the episodes: beta of Eq. (10), fusion and learning rates."""
        settings = self.settings
        if isinstance(self.buffer.sampler, SignalSampler):
            done = self.episode / max(self.total_episodes - 1, 1)
            start, end = settings.method.beta, settings.method.beta_end
            self.buffer.sampler.beta = start + (end - start) * done
            self.buffer.sampler.anneal(done)
        # Counted so that the last episode still learns.
        left = 1.0 - self.episode / self.total_episodes
        lowest, power = settings.learner.lr_end_factor, settings.learner.lr_power
        if power is None:
            power = 1.0 if self.total_episodes >= _MANY_EPISODES else 3.0
        self.learner.anneal(lowest + (1.0 - lowest) * left**power)

    # Saving ----------------------------------------------------------------------------------

    def _moment(self) -> Moment:
        """The run as it is now, between two episodes; its tensors are those that will change."""
        parts = {
            "learner": self.learner.state_dict(),
            "buffer": self.buffer.state_dict(),
            "explorer": self.explorer.state_dict(),
            "curiosity": None if self.curiosity is None else self.curiosity.checkpoint(),
        }
        return Moment(self.episode, self.step, parts, self.learner.policy)

    def save(self) -> None:
        """Write checkpoint, policy and records, each of them whole or not at all."""
        self._write(self._moment())

    def _write(self, moment: Moment) -> None:
        if moment.episode == 0:
            return
        records = self.records[: moment.episode]
        evaluations = [each for each in self.evaluations if each.episode <= moment.episode]
        state = {
            "format": FORMAT,
            "settings": asdict(self.settings),
            "wandb": self.tracker.run_id,
            "episode": moment.episode,
            "step": moment.step,
            **moment.parts,
            "records": [asdict(record) for record in records],
            "evaluations": [asdict(record) for record in evaluations],
        }
        save_atomically(state, self.folder / files.CHECKPOINT)
        policy = exported_policy(moment.policy, self.settings, records)
        save_policy(policy, self.folder / files.POLICY)
        write_table(as_table(records, EpisodeRecord), self.folder / files.EPISODES)
        if evaluations:
            table = as_table(evaluations, EvaluationRecord)
            write_table(table, self.folder / files.EVALUATIONS)

    def _load(self, state: dict[str, Any]) -> None:
        """Go on where a checkpoint was written."""
        self.learner.load_state_dict(state["learner"])
        self.buffer.load_state_dict(state["buffer"])
        self.explorer.load_state_dict(state["explorer"])
        if self.curiosity is not None:
            self.curiosity.restore(state["curiosity"])
        self.episode, self.step = state["episode"], state["step"]
        self.records = [EpisodeRecord(**record) for record in state["records"]]
        self.evaluations = [EvaluationRecord(**record) for record in state["evaluations"]]

    def close(self) -> None:
        """Release the simulation and finish the log."""
        self.driver.close()
        self.tracker.close()


def episode_seed(seed: int, episode: int) -> int:
    """A seed for each episode of each run."""
    return seed * 1_000_003 + episode


def prepare_process(settings: TrainSettings) -> None:
    """Set threads, arithmetic and logging."""
    torch.set_num_threads(settings.threads)
    # Weights that no gradient reaches decay until they are denormal numbers; after some five
    # thousand updates a CPU takes twice as long for each because of them.
    torch.set_flush_denormal(True)
    # By default a pool of processes would wait for programs to compile, of which there are two.
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
    # TorchRL announces each storage in the middle of the progress bar.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
