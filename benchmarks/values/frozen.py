"""Frozen buffers: the transitions of a run, its policy, and what the values of that policy are."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from training.settings.learners import LearnerSettings

FOLDER = Path(__file__).resolve().parents[2] / "docs/results/values"
"""Folder of the buffers that come with the project."""
_HALF = ("observation", "action", "behavior_mean", "behavior_sigma")
_RETURNS = ("observation", "action", "value", "long")
_NEXT = ("reward", "done", "terminated")


@dataclass(frozen=True)
class FrozenBuffer:
    """A buffer that no longer changes, the policy of its run, and that policy's values."""

    name: str
    """Reward, time and method of the run: ``sparse-early-per``."""
    learner: LearnerSettings
    """Settings of the run's learner, by which critics learn too."""
    robots: int
    """Robots of the run: the transition after one of theirs is so many rows later."""
    rows: TensorDict
    """The transitions in the order in which they were written, batch size ``[N]``, with all that
    any method asks for."""
    policy: dict[str, Tensor]
    """Weights of the actor."""
    returns: TensorDict
    """Episodes of the policy alone: ``"observation"``, ``"action"``, ``"value"``, the discounted
    sum of the rewards from there on, and ``"long"``, Q of long training; batch size ``[M]``."""
    value: Tensor
    """Q of long training with uniform replay, the mean of several critics, shape ``[N]``."""
    spread: float
    """Standard deviation of those critics around it, root of the mean square."""

    def __len__(self) -> int:
        return len(self.rows)

    def save(self, folder: Path) -> Path:
        """Write ``NAME.npz``: the same bytes for the same buffer."""
        rows, after = self.rows, self.rows["next"]
        # Most observations after an action are in a later row as well, and not written twice.
        linked = (rows["observation"].roll(-self.robots, 0) == after["observation"]).all(-1)
        linked[-self.robots :] = False
        ends = (~linked).nonzero().squeeze(-1)
        arrays: dict[str, Tensor] = {name: rows[name].half() for name in _HALF}
        arrays |= {name: after[name] for name in _NEXT}
        arrays |= {f"returns.{name}": self.returns[name].half() for name in _RETURNS}
        arrays |= {f"policy.{name}": weight for name, weight in self.policy.items()}
        arrays |= {
            "episode": rows["episode"].int(),
            "ends": ends.int(),
            "last_observation": after["observation"][ends].half(),
            "value": self.value.half(),
        }
        numbers = {"robots": self.robots, "spread": self.spread, "learner": asdict(self.learner)}
        plain: dict[str, Any] = {name: each.numpy() for name, each in arrays.items()}
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.npz"
        half_written = path.with_suffix(".part")
        with half_written.open("wb") as file:
            np.savez_compressed(file, settings=np.array(json.dumps(numbers)), **plain)
        os.replace(half_written, path)
        return path


def read_frozen(path: Path) -> FrozenBuffer:
    """Read what :meth:`FrozenBuffer.save` wrote; nothing in the file is executed."""
    with np.load(path, allow_pickle=False) as file:
        numbers = json.loads(str(file["settings"]))
        found = {name: torch.from_numpy(file[name]) for name in file.files if name != "settings"}
    halves = {name: each.float() for name, each in found.items() if each.dtype == torch.half}
    found |= halves
    after = found["observation"].roll(-numbers["robots"], 0)
    after[found["ends"].long()] = found["last_observation"]
    rows: dict[str, Any] = {name: found[name] for name in _HALF}
    rows["next"] = {"observation": after, **{name: found[name] for name in _NEXT}}
    rows["episode"] = found["episode"].long()
    return FrozenBuffer(
        name=path.stem,
        learner=LearnerSettings(**numbers["learner"]),
        robots=numbers["robots"],
        rows=TensorDict(rows, [len(after)]),
        policy={
            name.removeprefix("policy."): each
            for name, each in found.items()
            if name.startswith("policy.")
        },
        returns=TensorDict(
            {name: found[f"returns.{name}"] for name in _RETURNS}, [len(found["returns.value"])]
        ),
        value=found["value"],
        spread=numbers["spread"],
    )


def frozen_buffers(folder: Path = FOLDER) -> list[FrozenBuffer]:
    """Return the buffers of a folder by name, and raise without any."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise FileNotFoundError(
            f"no frozen buffers in {folder}: they come with the repository"
            " in docs/results/values, not with a release; `python -m benchmarks.values capture`"
            " makes them"
        )
    return [read_frozen(path) for path in paths]


def as_stored(rows: TensorDict) -> TensorDict:
    """Rows with the precision of the file, so that what is learned from both is the same."""
    rows = rows.clone()
    for name in _HALF:
        rows[name] = rows[name].half().float()
    rows["next", "observation"] = rows["next", "observation"].half().float()
    return rows
