"""Environments and episodes of one robot that several tests share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mpfa_envs import PAPER_TASK, NavigationEnv


def paper_env(**arguments: Any) -> NavigationEnv:
    """The paper's task, in which an action is one time step."""
    return NavigationEnv(**{**PAPER_TASK, **arguments})


def drive_to_end(
    env: NavigationEnv, act: Callable[[np.ndarray], Any], **task: Any
) -> tuple[float, bool, bool, dict[str, Any]]:
    """Sum of rewards, terminated, truncated and info at the end of an episode from (0, 0)."""
    seen, _ = env.reset(options={"start": (0.0, 0.0, 0.0), **task})
    total, terminated, truncated, info = 0.0, False, False, {}
    while not (terminated or truncated):
        seen, reward, terminated, truncated, info = env.step(act(seen))
        total += reward
    return total, terminated, truncated, info


def full_speed(_: np.ndarray) -> list[float]:
    return [1.0, 1.0]
