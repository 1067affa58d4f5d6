"""The arms, tasks, settings and seeds of the runs on goal tasks, and what a run is told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from itertools import product
from typing import Final

from torchrl_mpfa import METHODS

SB3, PER, MPFA = "SB3's HER", "PER with hindsight", "MPFA-PER with hindsight"
ARMS: Final = {
    "uniform": "uniform",
    "HER": "her",
    PER: "per --hindsight 4",
    MPFA: "mpfa_per --hindsight 4",
    "half batches with hindsight": "uniform_halves --hindsight 4",
}
"""What ``--replay`` of an arm is, and what follows it."""
PARTS: Final = {
    "MPFA-PER, neither raised nor decayed": "mpf_per --hindsight 4",
    "reward and TD error": "td_reward --hindsight 4",
    "TD error and action gradient": "td_loss --hindsight 4",
    "PER, raised": "raise --hindsight 4",
}
"""Parts of MPFA-PER with hindsight."""
EXPLORATORY: Final = {
    **PARTS,
    "HER, two updates a step": "her --updates 2",
    "HER, two updates of half a batch": "her --updates 2 --batch-size 128",
    "HER, eight goals an episode": "her --hindsight 8",
    "HER, goals for each transition": "her --goals-for transition",
}
"""Arms beside the design: parts, more updates, and more goals."""
EVERY: Final = {**ARMS, SB3: "", **EXPLORATORY}
STEPS: Final[Mapping[str, int]] = {
    "FetchReach-v4": 5_000,
    "PointMaze_UMaze-v3": 30_000,
    "PointMaze_Medium-v3": 60_000,
    "FetchPush-v4": 100_000,
}
"""Steps of a run, of which twenty have an evaluation after them."""
PLANNED: Final = tuple(STEPS)[:3]
"""Tasks of the planned comparisons."""
POSITIVE: Final[Mapping[str, float]] = {"FetchReach-v4": -0.5, "FetchPush-v4": -0.5}
"""Level above which a reward is positive: a step costs 1 there until the goal."""
COMMON: Final = {"width": 64, "batch-size": 256, "start": 1_000}
_FAST: Final = {"gamma": 0.98, "tau": 0.05, "noise": 0.3}
CHOSEN: Final[Mapping[str, Mapping[str, float]]] = {
    "FetchReach-v4": _FAST,
    "PointMaze_UMaze-v3": _FAST,
    "PointMaze_Medium-v3": _FAST,
    "FetchPush-v4": _FAST,
}
"""What the search chose for each task; FetchPush had none, and has what all the others have."""
CANDIDATES: Final = [
    {"gamma": gamma, "tau": tau, "noise": noise}
    for gamma, tau, noise in product((0.95, 0.98), (0.005, 0.05), (0.1, 0.3))
]
SEARCH_SEEDS: Final = (900, 901)
SEEDS: Final = range(100, 110)
SB3_SEEDS: Final = range(100, 105)


def words_of(task: str, seed: int, settings: Mapping[str, float]) -> list[str]:
    """Return the command line of a run but for its arm."""
    given = {**COMMON, "steps": STEPS[task], "every": STEPS[task] // 20, **settings}
    words = ["--task", task, "--seed", str(seed)]
    for name, value in given.items():
        words += [f"--{name}", str(value)]
    return words


def words_of_arm(arm: str, task: str) -> list[str]:
    """Return what an arm says, and above which reward is positive to a method that asks for it."""
    replay, *words = EVERY[arm].split()
    asks = {field.name for field in fields(METHODS[replay])}
    if task in POSITIVE and "positive_above" in asks:
        words.append(f"--positive-above={POSITIVE[task]}")
    return ["--replay", replay, *words]
