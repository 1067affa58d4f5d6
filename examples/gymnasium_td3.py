"""TD3 with any replay method on a task of Gymnasium, all of it on one page.

    python examples/gymnasium_td3.py --task HalfCheetah-v5 --replay mpfa_per --seed 0
    python examples/gymnasium_td3.py --task Hopper-v5 --positive-above 1    1 a step for standing
    python examples/report.py runs/td3                          tables of all runs, and their curves

MuJoCo's tasks need the extra ``mujoco``. Batches of 100 and rates of 0.001 are those of TD3's
paper; networks have 2 x 256 units, and the first 5,000 steps are at random. ``scores.csv`` in the
folder of a run has the mean return of ten episodes without noise. The file is written at the end:
a run that was stopped begins again. Methods that ask for more than a buffer and a loss, as
hindsight does, are trained by ``train.py``.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor
from tqdm import trange

import torchrl_mpfa as mpfa
from torchrl_mpfa.methods import loss_options, make_replay, method_named
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.saving import write_text_atomically

BATCH_SIZE, WIDTH = 100, 256
LEARNING_RATE = 1e-3
NOISE = 0.1
"""Standard deviation of the exploration noise, in halves of the action's range."""
STEPS_A_ROUND = 10
"""Steps of the task between two rounds of as many updates."""
EPISODES = 10
"""Episodes of an evaluation."""
SCORES, SETTINGS = "scores.csv", "settings.json"


class Task:
    """A task with actions in -1 to 1, whose steps come as rows of a replay.

    Args:
        name: Gymnasium id.
        seed: Of starts.
    """

    def __init__(self, name: str, *, seed: int) -> None:
        made = gymnasium.make(name)
        self.env = gymnasium.wrappers.RescaleAction(made, np.float32(-1.0), np.float32(1.0))
        self.state, _ = self.env.reset(seed=seed)
        [self.observations] = self.state.shape
        [self.actions] = self.env.action_space.shape or ()

    def step(self, before: Tensor, action: NDArray[np.float32]) -> TensorDict:
        """Step from an observation; return the transition ``[]``."""
        state, reward, terminated, truncated, _ = self.env.step(action)
        self.state, done = state, terminated or truncated
        if done:
            self.state, _ = self.env.reset()
        after = {
            "observation": _tensor(state),
            "reward": torch.tensor([float(reward)]),
            "terminated": torch.tensor([bool(terminated)]),
            "done": torch.tensor([bool(done)]),
        }
        rows = {"observation": before, "action": torch.from_numpy(action), "next": after}
        return TensorDict(rows, [])


def _tensor(state: NDArray[np.floating]) -> Tensor:
    """An observation as networks take it."""
    return torch.as_tensor(state, dtype=torch.float32)


def collect(task: Task, actor: DirectModule | None, source: np.random.Generator) -> TensorDict:
    """Step a round by the actor with noise, or at random; return its rows.

    Args:
        task: The task.
        actor: From observations to actions; None: at random.
        source: Of the noise.

    Returns:
        Transitions ``[STEPS_A_ROUND]``.
    """
    rows = []
    for _ in range(STEPS_A_ROUND):
        before = _tensor(task.state)
        action = source.uniform(-1.0, 1.0, task.actions)
        if actor is not None:
            noise = NOISE * source.standard_normal(task.actions)
            action = np.clip(actor.act(before).numpy() + noise, -1.0, 1.0)
        rows.append(task.step(before, action.astype(np.float32)))
    return torch.stack(rows)


def score(name: str, actor: DirectModule, *, seed: int) -> float:
    """Return the mean return of episodes without noise."""
    task, total, ended = Task(name, seed=seed), 0.0, 0
    while ended < EPISODES:
        before = _tensor(task.state)
        after = task.step(before, actor.act(before).numpy())["next"]
        total, ended = total + after["reward"].item(), ended + int(after["done"])
    task.env.close()
    return total / EPISODES


def train(options: argparse.Namespace) -> list[list[object]]:
    """Train; return a row of each evaluation: task, method, seed, steps, score."""
    torch.manual_seed(options.seed)
    source = np.random.default_rng(options.seed)
    task = Task(options.task, seed=options.seed)
    level = {} if options.positive_above is None else {"positive_above": options.positive_above}
    replay = make_replay(options.replay, capacity=options.steps, batch_size=BATCH_SIZE, **level)
    sizes: dict[str, Any] = {"width": WIDTH, "layer_norm": False}
    actor = mpfa.make_actor(task.observations, task.actions, **sizes)
    learner = mpfa.ActorCritic(
        actor,
        mpfa.make_critic(task.observations, task.actions, **sizes),
        gamma=0.99,
        tau=0.005,
        policy_noise=0.2,
        noise_clip=0.5,
        bounds=(-1.0, 1.0),
        policy_delay=2,
        actor_lr=LEARNING_RATE,
        critic_lr=LEARNING_RATE,
        compile=not options.eager,
        **loss_options(options.replay),
    )
    rows: list[list[object]] = []
    for done in (bar := trange(STEPS_A_ROUND, options.steps + 1, STEPS_A_ROUND, unit="round")):
        learning = done > options.start
        replay.buffer.extend(collect(task, actor if learning else None, source))
        if learning:
            replay.anneal(done / options.steps)  # As in PER, beta rises to 1.
            mpfa.run_updates(replay.buffer, learner, replay.select, updates=STEPS_A_ROUND)
        if done % options.every < STEPS_A_ROUND:
            reached = score(options.task, actor, seed=1_000_000)
            rows.append([options.task, f"td3/{options.replay}", options.seed, done, reached])
            bar.set_postfix_str(f"return {reached:.0f}")
    return rows


def main(arguments: Sequence[str] | None = None) -> Path:
    """Train, and write the scores; return the folder of the run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="HalfCheetah-v5", help="a Gymnasium id")
    offered = sorted(name for name, method in mpfa.METHODS.items() if not method.beside)
    parser.add_argument("--replay", choices=offered, default="mpfa_per")
    parser.add_argument(
        "--positive-above", type=float, help="reward, for MPFA-PER; between rewards"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--start", type=int, default=5_000, help="steps at random before learning")
    parser.add_argument("--every", type=int, default=5_000, help="steps between evaluations")
    parser.add_argument("--folder", type=Path, default=Path("runs/td3"), help="of all runs")
    parser.add_argument("--eager", action="store_true", help="do not compile the update")
    options = parser.parse_args(arguments)
    if options.start < BATCH_SIZE:
        parser.error(f"--start must be at least one batch of {BATCH_SIZE}, got {options.start}")
    if not STEPS_A_ROUND <= options.every <= options.steps:
        parser.error(f"--every must be in {STEPS_A_ROUND} to {options.steps}, got {options.every}")
    if options.positive_above is not None:
        try:
            method_named(options.replay, positive_above=options.positive_above)
        except (TypeError, ValueError) as error:
            parser.error(f"--positive-above: {error}")
    folder: Path = options.folder / f"{options.task}-{options.replay}-{options.seed}"
    chosen = json.dumps({k: v for k, v in vars(options).items() if k != "folder"}, indent=1)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / SCORES).exists():
            if (folder / SETTINGS).exists() and (folder / SETTINGS).read_text() != chosen:
                parser.error(f"{folder} has a run with other settings: choose another --folder")
            print(f"{folder} has its scores already")
            return folder
        write_text_atomically(chosen, folder / SETTINGS)
    except OSError as error:
        parser.error(str(error))
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)  # Tiny numbers would slow a CPU down.
    text = io.StringIO()
    written = csv.writer(text, lineterminator="\n")
    written.writerow(["task", "method", "seed", "steps", "score"])
    written.writerows(train(options))
    write_text_atomically(text.getvalue(), folder / SCORES)
    print(f"written: {folder / SCORES}")
    return folder


if __name__ == "__main__":
    main()
