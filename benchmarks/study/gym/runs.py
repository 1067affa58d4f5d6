"""The runs of table F in their folder: which are done, and how one is made."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from multiprocessing import parent_process
from multiprocessing.connection import wait
from pathlib import Path

from benchmarks.study.gym.training import Regime, Settings, prepare_process, train
from torchrl_mpfa.saving import write_text_atomically

SETTINGS = "settings.json"
EVALUATIONS = "evaluations.csv"


@dataclass(frozen=True)
class Run:
    """A run in a folder of its own; it is done once its evaluations are there."""

    settings: Settings
    folder: Path
    """Of all runs."""

    @property
    def name(self) -> str:
        """Name of the run, and of its folder."""
        return f"{self.settings.task}-{self.settings.method}-{self.settings.seed}"

    @property
    def path(self) -> Path:
        """Folder of the run."""
        return self.folder / self.name

    @property
    def evaluations(self) -> Path:
        """A row for each evaluation, written at the end."""
        return self.path / EVALUATIONS

    def is_done(self) -> bool:
        """Whether it came to its end."""
        return self.evaluations.exists()

    def difference(self) -> str:
        """Where the settings that it was made with are others; empty if nowhere, or not done.

        Examples:
            >>> Run(Settings("Pendulum-v1", "per", 100), Path("nowhere")).difference()
            ''
        """
        if not self.is_done():
            return ""
        had = _flat(json.loads((self.path / SETTINGS).read_text(encoding="utf-8")))
        asked = _flat(asdict(self.settings))
        names = [name for name in {**asked, **had} if had.get(name) != asked.get(name)]
        return "; ".join(f"{n}={had.get(n)}, asked for is {asked.get(n)}" for n in names)


def wanted(
    tasks: Sequence[str], methods: Sequence[str], seeds: Sequence[int], folder: Path, **regime: int
) -> list[Run]:
    """Runs in the order in which they are made: of each task and method the first seed first."""
    of_all = Regime(**regime)
    return [
        Run(Settings(task, method, seed, of_all), folder)
        for seed in seeds
        for task in tasks
        for method in methods
    ]


def make(run: Run) -> None:
    """Train, and write settings and rows, each of them whole or not at all."""
    found = train(run.settings)
    run.path.mkdir(parents=True, exist_ok=True)
    text = json.dumps(asdict(run.settings), indent=2) + "\n"
    write_text_atomically(text, run.path / SETTINGS)
    # Last: they say that the run is done.
    write_text_atomically(found.to_csv(index=False, lineterminator="\n"), run.evaluations)


def begin_worker() -> None:
    """Prepare a process for runs: Ctrl-C is its parent's, without which it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prepare_process()
    parent = parent_process()
    if parent is None:
        return

    def end_with_it(sentinel: int = parent.sentinel) -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=end_with_it, daemon=True, name="parent").start()


def _flat(settings: dict[str, object]) -> dict[str, object]:
    regime = settings.get("regime")
    return {**settings, **(regime if isinstance(regime, dict) else {}), "regime": None}
