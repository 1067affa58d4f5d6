"""The paper's task, in which an action is one time step: what the tests of mechanics count in."""

from __future__ import annotations

from typing import Any

from mpfa_envs import PAPER_TASK, NavigationEnv


def paper_env(**arguments: Any) -> NavigationEnv:
    return NavigationEnv(**{**PAPER_TASK, **arguments})
