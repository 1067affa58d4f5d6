"""TorchRL's own SAC in a plain loop, on any task of Gymnasium with continuous actions.

    python examples/torchrl_sac.py                              robots in new worlds, five minutes
    python examples/torchrl_sac.py --task Pendulum-v1 --actions 10000 --seed 1
    python examples/torchrl_sac.py --task Pendulum-v1 --replay mpfa --log wandb
    python examples/torchrl_sac.py --resume runs/sac/rooms-uniform-0    after Ctrl-C
    python examples/report.py runs/sac                          tables of all runs, and their curves

It is the model of a script of one's own: with seeds, logs, evaluation, an end that saves, and a
table of scores for ``report.py``. The files in the folder of a run, --output:

    scores.csv    task, method, seed, steps and score of each evaluation
    run.pt        what a run resumes from, and its transitions in replay/
    policy.npz    of robots alone, for ``evaluate.py`` and ``export.py``

The score is the mean return of greedy episodes, of robots the share that reached the goal. A
resumed run begins new episodes.
"""

from __future__ import annotations

import argparse
import csv
import io
import secrets
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    DoubleToFloat,
    EnvBase,
    ExplorationType,
    GymEnv,
    TransformedEnv,
    set_exploration_type,
)
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate
from torchrl.record.loggers import get_logger

from mpfa_envs import GENERATORS, ROOMS_TASK, Policy, evaluate, make_navigation_env, save_policy
from torchrl_mpfa import MPFASampler, SignalReplayBuffer, SignalTensorStorage, Stop, write_signals
from torchrl_mpfa.saving import load_safely, save_atomically, write_text_atomically

HIDDEN = [128, 128]
BATCH_SIZE = 256
CAPACITY = 100_000
RANDOM_ACTIONS = 2_048
LEARNING_RATE = 3e-4
ACTIONS_PER_UPDATE = 4
"""Actions of all robots together."""
FRAMES = 64
"""Actions between two rounds of updates."""
SENSES = {name: ROOMS_TASK[name] for name in ("robot", "physics", "memory", "clearance")}
"""Arguments of the environment that a policy needs wherever it drives."""
RUN, REPLAY, SCORES = "run.pt", "replay", "scores.csv"


def make_env(task: str, *, robots: int, seed: int) -> EnvBase:
    """Make a Gymnasium task, or robots in the worlds of a generator."""
    if task in GENERATORS:
        arguments = {**ROOMS_TASK, "world": task}
        return make_navigation_env(num_envs=robots, info_keys=["success"], seed=seed, **arguments)
    env = TransformedEnv(GymEnv(task), DoubleToFloat())
    env.set_seed(seed)
    return env


def make_networks(env: EnvBase) -> tuple[MLP, ProbabilisticActor, ValueOperator]:
    """The network of means and scales, the actor that samples from it, and the critic."""
    spec = env.action_spec_unbatched
    sizes = env.observation_spec["observation"].shape[-1], spec.shape[-1]
    network = MLP(
        in_features=sizes[0],
        out_features=2 * sizes[1],
        num_cells=HIDDEN,
        activation_class=nn.ReLU,
    )
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(network, NormalParamExtractor()),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high, "tanh_loc": False},
    )
    critic = ValueOperator(
        MLP(in_features=sum(sizes), out_features=1, num_cells=HIDDEN, activation_class=nn.ReLU),
        in_keys=["observation", "action"],
    )
    return network, actor, critic


def make_buffer(replay: str) -> TensorDictReplayBuffer:
    """TorchRL's uniform replay, or MPFA-PER, whose signals ``write_signals`` writes."""
    if replay == "uniform":
        return TensorDictReplayBuffer(storage=LazyTensorStorage(CAPACITY), batch_size=BATCH_SIZE)
    # Rewards may all have one sign: what is above their mean counts as positive.
    sampler = MPFASampler(CAPACITY, positive_above="mean")
    return SignalReplayBuffer(
        storage=SignalTensorStorage(CAPACITY), sampler=sampler, batch_size=BATCH_SIZE
    )


class Training:
    """A run: its parts, how far it is, and its scores.

    Args:
        settings: Options of the command line that a run keeps.
    """

    def __init__(self, settings: dict[str, Any]) -> None:
        self.settings, self.collected = settings, 0
        self.scores: list[list[Any]] = []
        torch.manual_seed(settings["seed"])
        self.env = make_env(settings["task"], robots=settings["robots"], seed=settings["seed"])
        self.network, self.actor, critic = make_networks(self.env)
        self.loss = SACLoss(self.actor, critic, loss_function="l2")
        self.loss.make_value_estimator(gamma=0.99)
        self.targets = SoftUpdate(self.loss, tau=0.005)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=LEARNING_RATE)
        self.buffer = make_buffer(settings["replay"])

    def update(self) -> dict[str, float]:
        """Learn from one batch; return the losses."""
        batch = self.buffer.sample()
        losses = self.loss(batch)
        (losses["loss_qvalue"] + losses["loss_actor"] + losses["loss_alpha"]).backward()
        if isinstance(self.buffer, SignalReplayBuffer):
            write_signals(batch, self.loss)  # Of the critics before their step.
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.targets.step()
        self.buffer.update_tensordict_priority(batch)  # Nothing, where replay is uniform.
        names = ("loss_qvalue", "loss_actor", "loss_alpha")
        return {name: losses[name].item() for name in names}

    def evaluate(self, episodes: int) -> float:
        """Return the score of the greedy policy, and keep its row."""
        settings = self.settings
        if settings["task"] in GENERATORS:
            worlds = f"{settings['task']}:validation"
            found = evaluate(policy_of(self.network, card={}), worlds, episodes=episodes)
            score = sum(each.success for each in found) / episodes
        else:
            env = make_env(settings["task"], robots=1, seed=1_000_000)
            with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
                runs = [env.rollout(100_000, self.actor) for _ in range(episodes)]
            score = sum(float(each["next", "reward"].sum()) for each in runs) / episodes
            env.close()
        method = f"sac/{settings['replay']}"
        self.scores.append(
            [settings["task"], method, settings["seed"], self.collected, round(score, 4)]
        )
        return score

    def save(self, folder: Path) -> None:
        """Write what the run resumes from, and its scores."""
        state = {
            "settings": self.settings,
            "collected": self.collected,
            "scores": self.scores,
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "random": torch.get_rng_state(),
        }
        self.buffer.dumps(folder / REPLAY)
        save_atomically(state, folder / RUN)
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerows([["task", "method", "seed", "steps", "score"], *self.scores])
        write_text_atomically(text.getvalue(), folder / SCORES)

    def load(self, folder: Path, state: dict[str, Any]) -> None:
        """Restore what :meth:`save` wrote."""
        self.collected, self.scores = state["collected"], state["scores"]
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.buffer.loads(folder / REPLAY)
        self.env.set_seed(self.settings["seed"] + self.collected)
        torch.set_rng_state(state["random"])


def train(run: Training, folder: Path, *, actions: int, every: int, episodes: int) -> bool:
    """Train to so many actions, or until asked to stop; return True if it was not."""
    frames = max(FRAMES, run.env.batch_size.numel())
    logger = get_logger(
        run.settings["log"],
        logger_name=str(folder),
        experiment_name=folder.name,
        wandb_kwargs={"project": "sac", "id": run.settings["id"], "resume": "allow"},
    )
    if logger is not None:
        logger.log_hparams(run.settings)
    collector = Collector(
        run.env,
        run.actor,
        frames_per_batch=frames,
        total_frames=-(-(actions - run.collected) // frames) * frames,  # Whole batches.
        init_random_frames=max(RANDOM_ACTIONS - run.collected, 0),
        auto_register_policy_transforms=True,
    )
    stop = Stop()
    with stop.listening():
        for steps in collector:  # [robots, T], or [T]
            run.buffer.extend(steps.reshape(-1))
            before, run.collected = run.collected, run.collected + steps.numel()
            entries: dict[str, float] = {}
            if run.collected >= RANDOM_ACTIONS:
                for _ in range(steps.numel() // ACTIONS_PER_UPDATE):
                    entries = run.update()
                collector.update_policy_weights_()
            if before // every != run.collected // every or run.collected >= actions:
                entries["score"] = run.evaluate(episodes)
                print(f"{run.collected:7} actions: score {entries['score']:.3f}", flush=True)
                if run.settings["replay"] == "mpfa":
                    entries |= {f"replay/{k}": v for k, v in run.buffer.stats().items()}
                for name, value in entries.items() if logger is not None else ():
                    logger.log_scalar(name, value, step=run.collected)
                run.save(folder)
            if stop:
                break
    run.save(folder)
    collector.shutdown()
    return not stop


def policy_of(network: MLP, *, card: dict[str, object]) -> Policy:
    """The greedy policy, the tanh of the means, which needs no PyTorch."""
    *hidden, last = network
    means = nn.Linear(last.in_features, last.out_features // 2)
    means.load_state_dict({k: v[: means.out_features] for k, v in last.state_dict().items()})
    return Policy.from_layers([*hidden, means, nn.Tanh()], card=card, env_arguments=SENSES)


def main(arguments: Sequence[str] | None = None) -> Path:
    """Train, and write scores and policy.

    Args:
        arguments: The command line.

    Returns:
        The folder of the run.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="mixed", help="a Gymnasium id, or a generator of worlds")
    parser.add_argument("--replay", choices=["uniform", "mpfa"], default="uniform")
    parser.add_argument("--robots", type=int, default=16, help="of a generator's worlds")
    parser.add_argument("--actions", type=int, default=100_000, help="of all robots together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every", type=int, default=5_000, help="actions between evaluations")
    parser.add_argument("--episodes", type=int, default=20, help="of an evaluation")
    parser.add_argument("--log", choices=["wandb", "tensorboard"], default="")
    parser.add_argument("--output", type=Path, help="folder (default: in runs/sac)")
    parser.add_argument("--resume", type=Path, metavar="FOLDER", help="with --actions alone")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)  # With networks this small a second one gains nothing.
    state = None if options.resume is None else load_safely(options.resume / RUN)
    names = ("task", "replay", "robots", "seed", "log")
    settings = {name: getattr(options, name) for name in names} | {"id": secrets.token_hex(4)}
    if state is not None:
        settings = state["settings"]
    name = "{task}-{replay}-{seed}".format(**settings).replace("/", "_")
    folder: Path = options.resume or options.output or Path("runs/sac") / name
    if state is None and (folder / RUN).exists():
        parser.error(f"{folder} holds a run: --resume {folder}, or name another --output")
    folder.mkdir(parents=True, exist_ok=True)
    run = Training(settings)
    if state is not None:
        run.load(folder, state)
    ended = train(
        run, folder, actions=options.actions, every=options.every, episodes=options.episodes
    )
    if settings["task"] in GENERATORS:
        card = {"learner": "torchrl sac", "method": settings["replay"], "seed": settings["seed"]}
        card |= {"curriculum": settings["task"], "steps": run.collected}
        save_policy(policy_of(run.network, card=card), folder, overwrite=True)
    print(f"written: {folder}" + ("" if ended else f"; continue with --resume {folder}"))
    return folder


if __name__ == "__main__":
    main()
    sys.exit(0)
