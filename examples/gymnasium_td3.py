"""TD3 with any replay method on a task of Gymnasium, all of it on one page.

    python examples/gymnasium_td3.py --task HalfCheetah-v5 --replay mpfa_per --seed 0
    python examples/gymnasium_td3.py --task Hopper-v5 --positive-above 1    1 a step for standing
    python examples/gymnasium_td3.py --task FetchReach-v4 --replay her    a goal task
    python examples/gymnasium_td3.py --task FetchReach-v4 --replay per --hindsight 4
    python examples/report.py runs/td3                          tables of all runs, and their curves

MuJoCo's tasks need the extra ``mujoco``, those of gymnasium-robotics the extra ``robotics``.
Batches of 100, rates of 0.001 and the form of the networks are those of TD3's paper; layers have
256 units, and the first 5,000 steps are at random. ``scores.csv`` in the folder of a run has the
mean return of ten episodes without noise, or of goal tasks the share of episodes that end at their
goal. ``replay.csv`` says at the same steps what was sampled, and the weights and shares of signals
(``docs/metrics.md``). Both are written at the end: a run that was stopped begins again.

A goal task has observations with ``achieved_goal`` and ``desired_goal``, and pays by
``compute_reward``. Networks read the goal as a part of the observation, whose numbers are
normalized by all that was seen. Episodes are learned from again with goals that they reached by
``--replay her``, or by ``--hindsight`` with any other method. Methods that ask for still more than
a buffer and a loss are trained by ``train.py``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

import torchrl_mpfa as mpfa
from torchrl_mpfa.methods import loss_options, make_replay, method_named
from torchrl_mpfa.methods.her import GOALS_FOR, GymnasiumGoals, HindsightGoals
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.selection import SampledBatch
from training import files
from training.finished import holds_result
from training.records import write_table

LEARNING_RATE = 1e-3
STEPS_A_ROUND = 10
"""Steps of the task between two rounds of as many updates."""
EPISODES = 10
"""Episodes of an evaluation."""
SCORES, STATISTICS = "scores.csv", "replay.csv"
GIVEN = {"episode", "hindsight"}
"""What this page gives a method beside its buffer, hindsight on goal tasks alone."""
_FARTHEST = 5.0
"""Where normalized numbers are cut off."""


class Task:
    """A task with actions in -1 to 1, whose steps come as rows of a replay.

    Args:
        name: Gymnasium id.
        seed: Of starts.

    Raises:
        ValueError: If observations are neither vectors nor those of a goal task, or actions are no
            vectors.
    """

    def __init__(self, name: str, *, seed: int) -> None:
        made = make(name)
        seen, space = made.observation_space, made.action_space
        self.has_goal = isinstance(seen, gymnasium.spaces.Dict)
        parts = [seen[key] for key in _PARTS] if isinstance(seen, gymnasium.spaces.Dict) else [seen]
        for part in (*parts, space):
            if not isinstance(part, gymnasium.spaces.Box) or len(part.shape) != 1:
                raise ValueError(f"task must have vectors to see and to do, got {name} with {part}")
        self.observations = sum(cast(Any, part).shape[0] for part in parts)
        [self.actions] = cast(tuple[int, ...], space.shape)
        self.env = gymnasium.wrappers.RescaleAction(made, np.float32(-1.0), np.float32(1.0))
        self.episode, self.reached = 0, False
        self.state = self._seen(self.env.reset(seed=seed)[0])

    def _seen(self, state: Any) -> NDArray[np.floating]:
        """An observation as a vector, which ends with the goal."""
        return np.concatenate([state[key] for key in _PARTS]) if self.has_goal else state

    @property
    def compute_reward(self) -> Callable[..., Any]:
        """The reward of goals in hindsight."""
        return cast(Callable[..., Any], self.env.get_wrapper_attr("compute_reward"))

    def step(self, before: Tensor, action: NDArray[np.float32]) -> TensorDict:
        """Step from an observation; return the transition ``[]``."""
        state, reward, terminated, truncated, info = self.env.step(action)
        self.state, done = self._seen(state), terminated or truncated
        after = {
            "observation": _tensor(self.state),
            "reward": torch.tensor([float(reward)]),
            "terminated": torch.tensor([bool(terminated)]),
            "done": torch.tensor([bool(done)]),
        }
        rows = {"observation": before, "action": torch.from_numpy(action), "next": after}
        if self.has_goal:
            after["achieved_goal"] = _tensor(state["achieved_goal"])
            self.reached = bool(info.get("is_success", info.get("success", False)))
        rows["episode"] = torch.tensor([self.episode])
        if done:
            self.episode += 1
            self.state = self._seen(self.env.reset()[0])
        return TensorDict(rows, [])


_PARTS = "observation", "desired_goal"
"""Entries of a goal task's observation that networks read."""


def _tensor(state: NDArray[np.floating]) -> Tensor:
    """An observation as networks take it."""
    return torch.as_tensor(state, dtype=torch.float32)


class Scale:
    """Mean and spread of all observations so far, by which they are normalized.

    Args:
        size: Numbers of an observation.
        moves: False leaves observations as they are.
    """

    def __init__(self, size: int, *, moves: bool) -> None:
        self.moves, self.count = moves, 0
        self.mean, self.squares = torch.zeros(size), torch.zeros(size)

    def see(self, observations: Tensor) -> None:
        """Take observations ``[B, O]`` into account."""
        self.count += len(observations)
        off = observations - self.mean
        self.mean += off.sum(0) / self.count
        self.squares += (off * (observations - self.mean)).sum(0)

    def __call__(self, observations: Tensor) -> Tensor:
        """Normalize observations ``[..., O]``."""
        if not self.moves or not self.count:
            return observations
        # Sums of what never changes are below zero by rounding.
        spread = (self.squares / self.count).clamp(min=0.0).sqrt().clamp(min=1e-2)
        return ((observations - self.mean) / spread).clamp(-_FARTHEST, _FARTHEST)

    def normalize(self, sampled: SampledBatch) -> SampledBatch:
        """Normalize the observations of sampled batches."""
        if not self.moves:
            return sampled
        batch = sampled.batch.clone(recurse=False)
        batch["next"] = batch["next"].clone(recurse=False)
        for rows in (batch, batch["next"]):
            rows["observation"] = self(rows["observation"])
        return replace(sampled, batch=batch)


class Acts:
    """An actor on observations as the task gives them."""

    def __init__(self, actor: DirectModule, scale: Scale) -> None:
        self.actor, self.scale = actor, scale

    def __call__(self, observation: Tensor) -> NDArray[np.float32]:
        """From an observation to an action without noise."""
        return cast(NDArray[np.float32], self.actor.act(self.scale(observation)).numpy())


def make(name: str) -> Any:
    """Make a task of Gymnasium, or of a package that registers its tasks once it is imported."""
    try:
        return gymnasium.make(name)
    except gymnasium.error.UnregisteredEnv:
        for package in ("gymnasium_robotics", "mpfa_envs"):
            with suppress(ImportError):
                import_module(package)
        return gymnasium.make(name)


def collect(
    task: Task, acts: Acts | None, source: np.random.Generator, *, noise: float = 0.1
) -> TensorDict:
    """Step a round by the actor with noise, or at random; return its rows.

    Args:
        task: The task.
        acts: From observations to actions; None: at random.
        source: Of the noise.
        noise: Standard deviation of the noise, in halves of the action's range.

    Returns:
        Transitions ``[STEPS_A_ROUND]``.
    """
    rows = []
    for _ in range(STEPS_A_ROUND):
        before = _tensor(task.state)
        action = source.uniform(-1.0, 1.0, task.actions)
        if acts is not None:
            step = noise * source.standard_normal(task.actions)
            action = np.clip(acts(before) + step, -1.0, 1.0)
        rows.append(task.step(before, action.astype(np.float32)))
    return torch.stack(rows)


def score(name: str, acts: Acts, *, seed: int) -> float:
    """Return the mean return of episodes without noise, or the share that end at their goal."""
    task, total, ended = Task(name, seed=seed), 0.0, 0
    while ended < EPISODES:
        before = _tensor(task.state)
        after = task.step(before, acts(before))["next"]
        done = bool(after["done"])
        total += float(done and task.reached) if task.has_goal else after["reward"].item()
        ended += done
    task.env.close()
    return total / EPISODES


def train(options: argparse.Namespace, task: Task) -> pd.DataFrame:
    """Train; return a row of each evaluation: its score, and what the replay says of itself."""
    torch.manual_seed(options.seed)
    source = np.random.default_rng(options.seed)
    replay = make_replay(options.replay, **options.method)
    method = replay.method
    if method.hindsight:
        relabel = GymnasiumGoals(task.compute_reward, goals_for=options.goals_for)
        replay.buffer.append_transform(HindsightGoals(relabel, goals=method.hindsight))
    kept = ["observation", "action", "next", *replay.entries]
    # Networks as TD3's authors have them; the defaults are DDPG's.
    form: dict[str, Any] = {"width": options.width, "layer_norm": False, "final_init": None}
    actor = mpfa.make_actor(task.observations, task.actions, **form)
    learner = mpfa.ActorCritic(
        actor,
        mpfa.make_critic(task.observations, task.actions, late_action=False, **form),
        gamma=options.gamma,
        tau=options.tau,
        policy_noise=0.2,
        noise_clip=0.5,
        bounds=(-1.0, 1.0),
        policy_delay=2,
        actor_lr=LEARNING_RATE,
        critic_lr=LEARNING_RATE,
        critic_weight_decay=0.0,
        compile=not options.eager,
        **loss_options(method),
    )
    scale = Scale(task.observations, moves=task.has_goal)
    acts = Acts(actor, scale)
    rows: list[dict[str, object]] = []
    rounds = range(STEPS_A_ROUND, options.steps + 1, STEPS_A_ROUND)
    bar = tqdm(rounds, f"{options.task} {options.name}", unit="step", unit_scale=STEPS_A_ROUND)
    for done in bar:
        learning = done > options.start
        found = collect(task, acts if learning else None, source, noise=options.noise)
        scale.see(found["observation"])
        if task.has_goal and not method.hindsight:
            del found["next", "achieved_goal"]
        replay.buffer.extend(found.select(*kept))
        if learning:
            replay.anneal(done / options.steps)  # As in PER, beta rises to 1.
            mpfa.run_updates(
                replay.buffer,
                learner,
                replay.select,
                updates=STEPS_A_ROUND * options.updates,
                prepare=scale.normalize,
            )
        if done % options.every < STEPS_A_ROUND:
            reached = score(options.task, acts, seed=1_000_000)
            rows.append({"steps": done, "score": reached, **replay.buffer.stats()})
            bar.set_postfix_str(f"score {reached:.4g}")
    table = pd.DataFrame(rows)
    for name in ("seed", "method", "task"):
        table.insert(0, name, f"td3/{options.name}" if name == "method" else getattr(options, name))
    return table


def parse(arguments: Sequence[str] | None) -> tuple[argparse.Namespace, Task]:
    """Read the command line and make the task, or end with what is wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="HalfCheetah-v5", help="a Gymnasium id")
    offered = sorted(name for name, method in mpfa.METHODS.items() if {*method.beside} <= GIVEN)
    parser.add_argument("--replay", choices=offered, default="mpfa_per")
    parser.add_argument(
        "--positive-above", type=float, help="reward, for MPFA-PER; between rewards"
    )
    parser.add_argument("--hindsight", type=int, help="goals for which an episode counts again")
    parser.add_argument("--goals-for", choices=GOALS_FOR, default=GOALS_FOR[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--start", type=int, default=5_000, help="steps at random before learning")
    parser.add_argument("--every", type=int, default=5_000, help="steps between evaluations")
    parser.add_argument("--updates", type=int, default=1, help="for each step")
    parser.add_argument("--batch-size", type=int, default=100)
    parser.add_argument("--width", type=int, default=256, help="units of a layer")
    parser.add_argument("--gamma", type=float, default=0.99)
    parser.add_argument("--tau", type=float, default=0.005, help="step of the target networks")
    parser.add_argument("--noise", type=float, default=0.1, help="of actions in -1 to 1")
    parser.add_argument("--folder", type=Path, default=Path("runs/td3"), help="of all runs")
    parser.add_argument("--eager", action="store_true", help="do not compile the update")
    options = parser.parse_args(arguments)
    if options.start < options.batch_size:
        least = f"one batch of {options.batch_size}"
        parser.error(f"--start must be at least {least}, got {options.start}")
    if not STEPS_A_ROUND <= options.every <= options.steps:
        parser.error(f"--every must be in {STEPS_A_ROUND} to {options.steps}, got {options.every}")
    if options.updates < 1:
        parser.error(f"--updates must be at least 1, got {options.updates}")
    if options.start >= options.steps:
        parser.error(f"--steps must be more than --start = {options.start}, got {options.steps}")
    if not 0 <= options.seed < 2**32:
        parser.error(f"--seed must be in 0 to 2**32 - 1, got {options.seed}")
    given = {}
    for name in ("batch_size", "positive_above", "hindsight"):
        if (value := getattr(options, name)) is not None:
            given[name] = value
            try:
                method = method_named(options.replay, **given)
            except (TypeError, ValueError) as error:
                parser.error(f"--{name.replace('_', '-')}: {error}")
    try:
        # An episode adds as many rows at most for each of its goals.
        options.method = given | {"capacity": options.steps * (1 + method.hindsight)}
        files.check_folder(options.folder)
        task = Task(options.task, seed=options.seed)
    except (ValueError, OSError, ImportError, gymnasium.error.Error) as error:
        parser.error(" ".join(str(error).split()))
    if method.hindsight and not task.has_goal:
        parser.error(f"--replay must be one without hindsight, as {options.task} has no goals")
    if options.goals_for == "transition" and not method.hindsight:
        parser.error("--goals-for must be episode without goals in hindsight, got transition")
    options.name = options.replay + (f"-hindsight{options.hindsight}" if options.hindsight else "")
    options.name += "-transitions" if options.goals_for == "transition" else ""
    options.name += f"-updates{options.updates}" if options.updates > 1 else ""
    return options, task


def main(arguments: Sequence[str] | None = None) -> Path:
    """Train, and write the scores; return the folder of the run."""
    options, task = parse(arguments)
    task_name = options.task.replace("/", "-").replace(":", "-")
    folder: Path = options.folder / f"{task_name}-{options.name}-{options.seed}"
    settings = {name: value for name, value in vars(options).items() if name != "folder"}
    settings["networks"] = "TD3"  # Runs of earlier versions had others.
    with files.lock(folder):
        try:
            held = holds_result(folder, SCORES, settings)
        except ValueError as error:
            raise SystemExit(f"gymnasium_td3.py: {error}") from None
        if held:
            print(f"{folder} has its scores already")
            return folder
        torch.set_num_threads(1)
        torch.set_flush_denormal(True)  # Tiny numbers would slow a CPU down.
        found = train(options, task)
        write_table(found.drop(columns="score"), folder / STATISTICS)
        write_table(found[["task", "method", "seed", "steps", "score"]], folder / SCORES)
    print(f"written: {folder / SCORES}")
    return folder


if __name__ == "__main__":
    files.run_script(main)
