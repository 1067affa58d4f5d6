"""The training run: episodes of the curriculum, one update a step, checkpoints between episodes."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from itertools import accumulate
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from tensordict import TensorDictBase
from tqdm import tqdm

from assembly import make_curiosity, make_learner
from collection import Collector, LocalCollector, RemoteCollector, Start
from exploration import make_explorer
from mpfa_envs import RandomMirror
from progress import Progress
from records import EpisodeRecord, ProgressRecord, save_policy, write_records
from replay_assembly import make_buffer, make_selection
from settings import Stage, TrainSettings
from torchrl_mpfa import Draw, SignalSampler, load_safely, save_atomically
from tracking import Tracker

FORMAT = 3
CHECKPOINT = "checkpoint.pt"
_RECENT = 20


class TrainingRun:
    """Everything that a run is: parts, progress and records.

    Randomness starts anew with each episode, from the seed of the run and the number of the
    episode, so that a run which was stopped between two episodes goes on as if it had not been.

    Args:
        settings: The settings.
        folder: Where checkpoints and records go.
    """

    def __init__(self, settings: TrainSettings, folder: Path) -> None:
        self.settings = settings
        self.folder = folder
        self.stages: list[Stage] = list(settings.curriculum.stages)
        self.total_episodes = sum(stage.episodes for stage in self.stages)
        torch.manual_seed(settings.seed)
        local = LocalCollector(settings, device=settings.device)
        env = local.environment(self.stages[0].world)
        self._action_spec = env.action_spec
        self._observation_size = env.observation_spec["observation"].shape[-1]
        self._build()
        self.collector: Collector = local
        if settings.overlap:
            local.close()
            self.collector = RemoteCollector(
                settings, self.learner.policy, example=env.fake_tensordict()
            )
        self._waiting: list[TensorDictBase] = []
        self.episode = 0
        self.step = 0
        self.records: list[EpisodeRecord] = []
        self.progress: list[ProgressRecord] = []
        self.evaluations = Progress(settings)
        self.tracker = Tracker(settings, folder)
        self._stop = False

    def _build(self) -> None:
        """Make the parts that learn, and the buffer."""
        settings, spec = self.settings, self._action_spec
        sizes = self._observation_size, spec.shape[-1]
        self.buffer = make_buffer(settings.method, seed=settings.seed)
        if settings.environment.mirror:
            self.buffer.append_transform(RandomMirror())
        self.learner = make_learner(
            settings.learner, settings.method, *sizes, device=settings.device
        )
        self.curiosity = make_curiosity(settings.method, *sizes, device=settings.device)
        self.explorer = make_explorer(self.learner.policy, settings.exploration, spec)
        self.select = make_selection(
            settings.method, self.learner.policy, lambda: self.explorer.sigma
        )

    # Episodes --------------------------------------------------------------------------------

    def train(self, on_episode: Callable[[EpisodeRecord], None] | None = None) -> bool:
        """Run to the end of the curriculum, or until Ctrl-C.

        Args:
            on_episode: Called with the record of each finished episode.

        Returns:
            Whether the curriculum was finished.
        """
        previous = signal.signal(signal.SIGINT, self._on_interrupt)
        bar = tqdm(total=self.total_episodes, initial=self.episode, unit="episode", smoothing=0.05)
        try:
            while self.episode < self.total_episodes and not self._stop:
                record = self._run_episode()
                self.records.append(record)
                self.episode += 1
                self.tracker.log_episode(record, self.step)
                self._evaluate(since=self.step - record.steps)
                bar.update()
                bar.set_postfix_str(self._summary())
                if self.episode % self.settings.checkpoint_every == 0:
                    self.save()
                if on_episode is not None:
                    on_episode(record)
        finally:
            bar.close()
            signal.signal(signal.SIGINT, previous)
        self.save()
        return self.episode == self.total_episodes

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        if self._stop:  # The second Ctrl-C does not wait for the episode to end.
            raise KeyboardInterrupt
        self._stop = True
        tqdm.write("stopping after this episode; Ctrl-C again to stop at once")

    def _summary(self) -> str:
        recent = self.records[-_RECENT:]
        success = sum(r.success for r in recent) / len(recent)
        return f"map {recent[-1].world}, success {success:.0%} of last {len(recent)}"

    def _stage(self, episode: int) -> Stage:
        for stage in self.stages:
            if episode < stage.episodes:
                return stage
            episode -= stage.episodes
        return self.stages[-1]

    def _begins_stage(self) -> bool:
        """Whether the next episode is the first one on a map, but for the first map."""
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
        self.collector.begin(Start(world, seed, self.step), self.explorer)
        done = False
        while not done:
            transition = self.collector.collect()
            self.step += 1
            steps += 1
            after = transition["next"]
            total_reward += after["reward"].item()
            done = after["done"].item()
            if not done:
                self.collector.proceed()
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
            **self.collector.info(),
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
        for number, drawn in enumerate(self.select(self.buffer)):
            draw = drawn if device == "cpu" else _moved(drawn, device)
            bonus = {} if self.curiosity is None else self.curiosity(draw.batch)
            losses = self.learner.update(
                draw.batch,
                actor_batch=draw.actor_batch,
                loss_function=draw.loss_function,
                new_step=number == 0,
            )
            batch = draw.batch if device == "cpu" else draw.batch.to("cpu")
            self.buffer.update_tensordict_priority(batch)
        if self.step % self.settings.tracking.log_every == 0:
            self.tracker.log_update(self.step, {**losses, **bonus}, self.buffer, batch)

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
        lowest = settings.learner.lr_end_factor
        self.learner.anneal(lowest + (1.0 - lowest) * left**settings.learner.lr_power)

    def _evaluate(self, *, since: int) -> None:
        """Evaluate if that fell due after step ``since``; nothing of the training is touched."""
        every = self.settings.evaluation.every
        if every > 0 and self.step // every != since // every:
            self.evaluations.start(self.learner.policy, total_steps=self.step, episode=self.episode)
        self._take_evaluations()

    def _take_evaluations(self, *, wait: bool = False) -> None:
        for record in self.evaluations.finished(wait=wait):
            self.progress.append(record)
            self.tracker.log_progress(record, self.step)

    # Saving ----------------------------------------------------------------------------------

    def save(self) -> None:
        """Write checkpoint, policy and records, each of them whole or not at all."""
        # A run that is killed goes on behind these, and would not evaluate them again.
        self._take_evaluations(wait=True)
        state = {
            "format": FORMAT,
            "settings": asdict(self.settings),
            "episode": self.episode,
            "step": self.step,
            "learner": self.learner.state_dict(),
            "buffer": self.buffer.state_dict(),
            "explorer": self.explorer.state_dict(),
            "curiosity": None if self.curiosity is None else self.curiosity.checkpoint(),
            "records": [asdict(record) for record in self.records],
            "progress": [asdict(record) for record in self.progress],
        }
        save_atomically(state, self.folder / CHECKPOINT)
        save_policy(self.learner.policy, self.settings, self.records, self.folder / "policy.pt")
        write_records(self.records, EpisodeRecord, self.folder / "episodes.csv")
        if self.progress:
            write_records(self.progress, ProgressRecord, self.folder / "progress.csv")

    def load(self, state: dict[str, Any]) -> None:
        """Go on where a checkpoint was written."""
        self.learner.load_state_dict(state["learner"])
        self.buffer.load_state_dict(state["buffer"])
        self.explorer.load_state_dict(state["explorer"])
        if self.curiosity is not None:
            self.curiosity.restore(state["curiosity"])
        self.episode, self.step = state["episode"], state["step"]
        self.records = [EpisodeRecord(**record) for record in state["records"]]
        self.progress = [ProgressRecord(**record) for record in state["progress"]]

    def close(self) -> None:
        """Release the simulation and finish the log."""
        self.collector.close()
        self.evaluations.close()
        self.tracker.close()


def _moved(draw: Draw, device: str) -> Draw:
    """The batches of a draw on another device."""
    actor_batch = None if draw.actor_batch is None else draw.actor_batch.to(device)
    return replace(draw, batch=draw.batch.to(device), actor_batch=actor_batch)


def episode_seed(seed: int, episode: int) -> int:
    """A seed for each episode of each run."""
    return seed * 1_000_003 + episode


def read_checkpoint(folder: Path) -> dict[str, Any]:
    """Read a run's checkpoint without executing anything in it.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If another version wrote it.
    """
    file = folder / CHECKPOINT
    if not file.exists():
        raise FileNotFoundError(f"resume: there is no {CHECKPOINT} in {folder}")
    state: dict[str, Any] = load_safely(file)
    if state.get("format") != FORMAT:
        raise ValueError(f"{file} has format {state.get('format')}, this version reads {FORMAT}")
    return state
