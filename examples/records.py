"""What a run leaves behind: a row per episode, a policy file, a picture of the learning."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from tensordict.nn import TensorDictModule

from settings import Learner, TrainSettings
from torchrl_mpfa import load_safely, save_atomically

POLICY_FORMAT = 3


@dataclass
class EpisodeRecord:
    """One training episode."""

    episode: int
    world: str
    steps: int
    total_steps: int
    reward: float
    """Total reward."""
    average_reward: float
    """Total reward over steps, the paper's curve."""
    seconds: float
    """Wall-clock time [s]."""
    success: bool
    collision: bool
    timeout: bool
    path_length: float
    """Distance driven [m]."""
    shortest_path: float
    """Shortest path of the task [m]."""


@dataclass
class ProgressRecord:
    """One evaluation during training."""

    total_steps: int
    episode: int
    """Training episodes finished."""
    world: str
    """Where it was evaluated."""
    success: float
    collision: float
    timeout: float
    spl: float
    seconds: float
    """Wall-clock time that it took [s]."""


def write_text_atomically(text: str, path: Path) -> None:
    """Write a text file in one step: the old one or the new one, never half."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def write_rows(rows: Sequence[dict[str, Any]], names: Sequence[str], path: Path) -> None:
    """Write rows as CSV in one step."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(names))
    writer.writeheader()
    writer.writerows(rows)
    write_text_atomically(text.getvalue(), path)


def write_records(
    records: Sequence[Any], kind: type[EpisodeRecord] | type[ProgressRecord], path: Path
) -> None:
    """Write records of one kind as CSV."""
    names = [entry.name for entry in fields(kind)]
    write_rows([asdict(record) for record in records], names, path)


def save_policy(
    policy: TensorDictModule,
    settings: TrainSettings,
    records: Sequence[EpisodeRecord],
    path: Path,
) -> None:
    """Write the policy with what is needed to use it: settings and training history in short."""
    state = {
        "format": POLICY_FORMAT,
        "learner": asdict(settings.learner),
        "environment": asdict(settings.environment),
        "trained": {
            "method": settings.method.name,
            "curriculum": settings.curriculum.name,
            "seed": settings.seed,
            "episodes": len(records),
            "steps": records[-1].total_steps if records else 0,
        },
        "weights": {name: value.cpu() for name, value in policy.module.state_dict().items()},
    }
    save_atomically(state, path)


def load_policy(path: Path) -> tuple[TensorDictModule, dict[str, Any]]:
    """Read a policy file without executing anything in it.

    Args:
        path: The file, or the folder of a run.

    Returns:
        The policy, and what else the file says.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If another version wrote it.
    """
    from assembly import make_policy

    file = path / "policy.pt" if path.is_dir() else path
    if not file.exists():
        raise FileNotFoundError(f"there is no policy at {file}; train.py writes policy.pt")
    state: dict[str, Any] = load_safely(file)
    if (
        not isinstance(state, dict)
        or state.get("format") != POLICY_FORMAT
        or "weights" not in state
    ):
        raise ValueError(f"{file} is no policy of format {POLICY_FORMAT}")
    weights = state["weights"]
    first = next(value for value in weights.values() if value.ndim == 2)
    last = [value for value in weights.values() if value.ndim == 2][-1]
    policy = make_policy(Learner(**state["learner"]), first.shape[1], last.shape[0])
    policy.module.load_state_dict(weights)
    return policy, state


def draw_learning_curve(records: Sequence[EpisodeRecord], path: Path, *, window: int = 20) -> None:
    """Draw success and average reward over the episodes, with the maps in the background.

    Args:
        records: The episodes.
        path: The PNG file.
        window: Episodes of the running mean.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    episodes = np.arange(1, len(records) + 1)
    figure, axes = pyplot.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
    curves = (
        ("success rate", np.array([r.success for r in records], float)),
        ("average reward per step", np.array([r.average_reward for r in records])),
    )
    for axis, (label, values) in zip(axes, curves, strict=True):
        axis.plot(episodes, values, ".", color="0.75", markersize=3)
        axis.plot(episodes, running_mean(values, window), color="tab:blue")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        for start in range(1, len(records)):
            if records[start].world != records[start - 1].world:
                axis.axvline(start + 0.5, color="0.5", linestyle=":")
    axes[0].set_title(f"mean of {window} episodes; dots are single ones")
    axes[1].set_xlabel("episode")
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def running_mean(values: np.ndarray[Any, Any], window: int) -> np.ndarray[Any, Any]:
    """Mean of the last ``window`` values, of fewer at the start."""
    sums = np.cumsum(np.concatenate(([0.0], values)))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    mean: np.ndarray[Any, Any] = (sums[ends] - sums[starts]) / (ends - starts)
    return mean
