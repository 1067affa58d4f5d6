"""Plot what each method trains on: how often it samples which transitions of a common buffer.

    python -m benchmarks.sampling          to docs/methods/images, all methods but those that
                                                 sample uniformly
    python -m benchmarks.sampling per mpfa_per --output runs/figures

The buffer is synthetic: a quarter of a navigation run, with few goals and collisions, widely spread
TD errors and gradients, and actions that are farther from the policy the older they are. Its
signals are constant. Batches are sampled and priorities updated until these have settled; then
samples are counted.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import RandomSampler
from tqdm import tqdm

from benchmarks.paper.methods import RECONSTRUCTIONS
from benchmarks.paper.methods.mw import MW
from mpfa_envs.render.charts import finish, look, new_figure
from torchrl_mpfa import SignalReplayBuffer, SignalSampler, make_actor
from torchrl_mpfa.checks import unknown
from torchrl_mpfa.methods import ALIASES, METHODS, Method, make_replay
from torchrl_mpfa.methods.ref_er import ReFERSampler
from training.files import check_folder, run_script

COUNT = 2_000
BATCH_SIZE = 128
ROUNDS = 600
"""Training steps until priorities have settled, and as many again that count."""
PICTURED = {**METHODS, **RECONSTRUCTIONS}
"""Methods of the package and of the paper's table."""
REPLAY_CAP = 60
"""In place of 1,024, which so few training steps do not reach."""
EPISODE_LENGTH = 50
SIGMA = 0.2
OBSERVATION_SIZE, ACTION_SIZE = 8, 2
KINDS = ("approaching", "moving away", "goal", "collision")
COLORS = ("#0072b2", "0.6", "#009e73", "#d55e00")
"""Colors of the kinds: those of :mod:`mpfa_envs.render`, and gray."""
_RARE = 0.05
"""Place of transitions that are sampled more rarely, or never."""
Array = NDArray[np.float64]


@dataclass
class Transitions:
    """The common buffer: transitions, and what a learner would write about them."""

    data: TensorDict
    signals: dict[str, Tensor]
    kind: NDArray[np.int64]
    """Number of the kind in :data:`KINDS`, shape ``[N]``."""


def make_transitions(policy: Any, *, count: int, seed: int = 0) -> Transitions:
    """Make up the buffer, oldest transition first."""
    rng = np.random.default_rng(seed)
    kind = rng.choice(len(KINDS), size=count, p=(0.6, 0.35, 0.02, 0.03))
    step = rng.uniform(0.02, 0.25, count) * np.array((1.0, -1.0, 0.0, 0.0))[kind]
    reward = step + np.array((0.0, 0.0, 10.0, -5.0))[kind]
    # Ends are rare and large, hence badly foreseen.
    td_error = rng.lognormal(-0.7, 1.0, count) * np.array((1.0, 1.0, 3.0, 4.0))[kind]
    gradient = rng.lognormal(-0.5, 0.7, count)
    value = rng.normal(4.0, 2.0, count) + np.array((0.5, -1.0, 4.0, -6.0))[kind]
    observation = torch.as_tensor(rng.normal(size=(count, OBSERVATION_SIZE)), dtype=torch.float)
    with torch.no_grad():
        chosen = policy.outputs({"observation": observation})["action"]
    # From twice the present noise to the present noise, and a bias that fades.
    age = torch.linspace(1.0, 0.0, count).unsqueeze(1)
    noise = torch.as_tensor(rng.normal(size=(count, ACTION_SIZE)), dtype=torch.float)
    action = (chosen + 0.3 * age + SIGMA * (1.0 + age) * noise).clamp(-1.0, 1.0)
    data = TensorDict(
        {
            "observation": observation,
            "action": action,
            "behavior_mean": action - SIGMA * (1.0 + age) * noise,
            "behavior_sigma": SIGMA * (1.0 + age),
            "episode": torch.arange(count).unsqueeze(1) // EPISODE_LENGTH,
            "next": {
                "reward": torch.as_tensor(reward, dtype=torch.float).unsqueeze(1),
                "done": (torch.arange(count).unsqueeze(1) + 1) % EPISODE_LENGTH == 0,
            },
        },
        [count],
    )
    # Half of the places are noisy, with a deviation of 1, and half are hardly so.
    deviation = rng.choice((0.1, 1.0), size=count)
    known = {
        **{"td_error": td_error, "action_gradient": gradient, "value": value},
        "information_gain": 0.5 * np.log1p((td_error / deviation) ** 2),
    }
    signals = {name: torch.as_tensor(v, dtype=torch.float) for name, v in known.items()}
    return Transitions(data, signals, kind)


def samples_uniformly(method: Method) -> bool:
    """Return True if every transition is sampled as often as any other."""
    return (
        type(method.sampler()) in (RandomSampler, ReFERSampler) and method.rows == method.batch_size
    )


def count_samples(method: Method, *, seed: int = 0) -> tuple[Transitions, dict[str, Array]]:
    """Count samples of a method relative to uniform ones, ``[N]``, for critic and actor."""
    torch.manual_seed(0)
    policy = make_actor(OBSERVATION_SIZE, ACTION_SIZE, width=16, final_init=0.5)
    transitions = make_transitions(policy, count=COUNT)
    if isinstance(method, MW):
        method = replace(method, replay_cap=REPLAY_CAP)
    replay = make_replay(
        method,
        capacity=COUNT,
        batch_size=BATCH_SIZE,
        generator=torch.Generator().manual_seed(seed),
        policy=policy,
        sigma=SIGMA,
    )
    buffer = replay.buffer
    buffer.extend(transitions.data)
    if isinstance(buffer.sampler, SignalSampler):
        buffer.sampler.anneal(1.0)
    counts = {"critic": torch.zeros(COUNT), "actor": torch.zeros(COUNT)}
    own = False
    for number in range(2 * ROUNDS):
        for sampled in replay.select(buffer):
            own = own or sampled.trains != "both"
            if number >= ROUNDS:
                for who in counts if sampled.trains == "both" else (sampled.trains,):
                    counts[who] += torch.bincount(sampled.batch["index"], minlength=COUNT)
            if sampled.gives_signals:
                _update(buffer, sampled.batch, transitions, replay.signals)
    found = {who: (each / each.mean()).double().numpy() for who, each in counts.items()}
    return transitions, found if own else {"critic": found["critic"]}


def _update(
    buffer: SignalReplayBuffer,
    batch: TensorDictBase,
    transitions: Transitions,
    names: Sequence[str],
) -> None:
    """Write the signals in a batch, as a learner would, and update the priorities."""
    if not names:
        return
    for name in names:
        batch["signals", name] = transitions.signals[name][batch["index"]]
    buffer.update_tensordict_priority(batch)


def plot(name: str, path: Path) -> None:
    """Plot the figure of a method."""
    transitions, found = count_samples(PICTURED[name])
    figure, axes = new_figure(1, 3, panel=(2.4, 2.6))
    error = transitions.signals["td_error"].numpy()
    for number, (kind, color) in enumerate(zip(KINDS, COLORS, strict=True)):
        chosen = transitions.kind == number
        often = np.maximum(found["critic"][chosen], _RARE)
        axes[0].plot(error[chosen], often, ".", ms=3, color=color, alpha=0.6, label=kind)
    # On a logarithmic scale one transition that is sampled all the time flattens no others.
    ends = max(found["critic"].min(), _RARE) / 1.5, found["critic"].max() * 1.5
    limits = min(ends[0], 0.09), max(ends[1], 11.0)
    axes[0].set(xscale="log", yscale="log", xlabel="|TD error|", ylim=limits)
    axes[0].yaxis.set_major_formatter(lambda often, _: f"{often:g}")
    axes[0].tick_params(which="minor", labelleft=False)
    width = 0.8 / len(found)
    edges = np.linspace(0, COUNT, 11).astype(int)
    for place, (who, often) in enumerate(found.items()):
        by_kind = [often[transitions.kind == number].mean() for number in range(len(KINDS))]
        where = np.arange(len(KINDS)) + place * width - 0.4 + width / 2
        shade = 1.0 if place == 0 else 0.45
        axes[1].bar(where, by_kind, width, color=COLORS, alpha=shade)
        by_age = [often[a:b].mean() for a, b in pairwise(edges)]
        axes[2].plot(np.arange(10) + 0.5, by_age, "o-", ms=3, color=look(place)["color"], label=who)
    axes[1].set_xticks([])
    axes[1].set_xlabel("kind" if len(found) == 1 else "kind; pale: actor")
    low, high = axes[2].get_ylim()
    axes[2].set(xlabel="tenth of the buffer by age", ylim=(min(low, 0.8), max(high, 1.2)))
    axes[2].set_xticks([0.5, 9.5], ["oldest", "newest"])
    if len(found) > 1:
        axes[2].legend(fontsize="small", frameon=False)
    for axis in axes:
        axis.axhline(1.0, color="0.3", lw=0.8, ls=":")
    figure.supylabel("times as often as uniformly", fontsize="medium")
    # Above the panels, where no point lies.
    kinds = axes[0].get_legend_handles_labels()
    figure.legend(*kinds, loc="outside upper center", ncols=4, frameon=False, markerscale=3)
    finish(figure, axes, path, dpi=160)


def main(arguments: Sequence[str] | None = None) -> int:
    """Plot the figures that are asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sampling",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("methods", nargs="*", help="names (default: all)")
    parser.add_argument("--output", type=Path, default=Path("docs/methods/images"))
    options = parser.parse_args(arguments)
    for name in options.methods:
        if name not in PICTURED:
            parser.error(unknown("method", name, PICTURED))
    try:
        check_folder(options.output)
    except ValueError as error:
        parser.error(f"--output: {error}")
    names = options.methods or [
        name
        for name, method in PICTURED.items()
        if name not in ALIASES and not samples_uniformly(method)
    ]
    torch.set_num_threads(1)
    # TorchRL announces each storage in the middle of the progress bar.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    for name in tqdm(names, unit="figure"):
        plot(name, options.output / f"{name}.png")
    return 0


if __name__ == "__main__":
    run_script(main)
