"""Updates of this package against SBX (Stable-Baselines3 in JAX), the fastest peer on a CPU.

SBX runs in a process of its own, by this Python (``pip install -e .[peers]``) or by the one that
``SBX_PYTHON`` names. Both have one thread, no LayerNorm, and batches of 256; the time is CPU time,
sampling included. Ours samples by MPFA-PER and writes priorities, SBX samples uniformly.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.speed import sbx_peer
from benchmarks.speed.timing import (
    MICROSECONDS,
    Call,
    Entry,
    entry,
    report_progress,
    take_turns,
)
from benchmarks.speed.training import Agent, make_loop
from torchrl_mpfa import run_updates
from training.run.assembly import has_compiler

CASES = {
    **{f"update_{kind}_{width}": (kind, width) for kind in ("ddpg", "td3") for width in (64, 256)},
    "loop_ddpg_64": ("ddpg", 64),
}
"""Algorithm and units of a hidden layer by the name of an entry."""
_STEPS = 100
"""Steps of a call of SBX's ``learn``, which spreads what it does at its start over as many."""


class Peer:
    """A process of SBX, whose calls count as time of this one."""

    def __init__(self, python: str, algorithm: str, width: int, part: str, size: int) -> None:
        script = [str(Path(sbx_peer.__file__)), algorithm, str(width), part]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        alone = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        self._process = subprocess.Popen([python, *script], text=True, env=alone, **pipes)
        self._size = self._waiting = size
        self.spent = 0.0
        """CPU time of the calls so far [s]."""
        self._make()

    def __call__(self) -> None:
        """Make an update or a step; as many as a call has are made by the first of them."""
        if self._waiting == self._size:
            self.spent += self._make()
            self._waiting = 0
        self._waiting += 1

    def _make(self) -> float:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(f"{self._size}\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"SBX ended with status {self._process.wait()}")
        return float(line)

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def make_updates(algorithm: str, width: int, *, compile: bool) -> Call:
    """One of sixteen updates of this package, which :func:`run_updates` makes at once."""
    agent, waiting = Agent(plain=True, width=width, compile=compile, algorithm=algorithm), 0

    def update() -> None:
        nonlocal waiting
        if waiting == 0:
            run_updates(agent.buffer, agent.learner, updates=sbx_peer.UPDATES)
            waiting = sbx_peer.UPDATES
        waiting -= 1

    return update


def measure(name: str, *, quick: bool) -> list[Entry]:
    """Compare updates, or the whole loop of one robot on an environment that does nothing.

    Args:
        name: One of :data:`CASES`.
        quick: Fewer and shorter rounds, and nothing compiled.

    Returns:
        An entry for each; ours has the ratio. None without SBX.
    """
    python = os.environ.get("SBX_PYTHON")
    if python is None and importlib.util.find_spec("sbx") is None:
        report_progress(f"{name}: left out, no sbx-rl here, nor a Python with it in SBX_PYTHON")
        return []
    algorithm, width = CASES[name]
    part, compile = name.split("_")[0], not quick and has_compiler()
    block = sbx_peer.UPDATES if part == "update" else _STEPS
    if part == "update":
        ours = make_updates(algorithm, width, compile=compile)
    else:
        ours = make_loop(compile=compile, width=width)
    theirs = Peer(python or sys.executable, algorithm, width, part, block)
    try:
        timings = take_turns(
            {f"{name}_sbx": theirs, name: ours},
            rounds=3 if quick else 7,
            seconds=0.05 if quick else 0.5,
            clock=lambda: time.process_time() + theirs.spent,
            multiple_of=block,
        )
    finally:
        theirs.close()
    own, other = timings[name], timings[f"{name}_sbx"]
    ratio: dict[str, Any] = {"ratio": own.ratio(other), "baseline": f"{name}_sbx"}
    return [
        entry(f"{name}_sbx", other.median * MICROSECONDS, "us"),
        entry(name, own.median * MICROSECONDS, "us", **ratio),
    ]
