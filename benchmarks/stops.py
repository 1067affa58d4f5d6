"""Stop training runs at random moments, resume them, and compare each with a run that went through.

    python -m benchmarks.stops                     all kinds of stops, to docs/results/stops.csv
    python -m benchmarks.stops --kinds SIGKILL disk --trials 5 --rows runs/stops.csv
    python -m benchmarks.stops --trials 0          only the table of the rows

A run is ``train.py`` in a child of this process, which has imported everything. A moment is a share
of the time that one phase takes. A full disk needs a file system that a root may mount; anybody is
root in ``unshare -Urm python -m benchmarks.stops``.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from mpfa_envs import load_policy
from mpfa_envs.render import charts
from torchrl_mpfa import SignalReplayBuffer
from torchrl_mpfa.saving import load_safely
from training import figures, files
from training.records import read_table, write_table
from training.run import script, tracking
from training.run.loop import TrainingRun
from training.run.schedule import Schedule

ROWS = Path(__file__).parents[1] / "docs/results/stops.csv"
SETTINGS = [
    *("regime=paper", "curriculum=A", "actions=240", "robots=4", "seed=5", "checkpoint_every=40"),
    *("environment.physics=kinematic", "environment.max_steps=12", "exploration.random_steps=40"),
    *("learner.width=8", "learner.compile=false", "method.batch_size=8", "method.capacity=200"),
    *("evaluation.every=60", "evaluation.world=A", "evaluation.episodes=4"),
    *("tracking=[tensorboard,csv]", "tracking.log_every=20"),
]
"""A run of 60 iterations, in which the replay memory is filled and written over."""
PHASES = ("start", "drive", "write", "update", "evaluation", "checkpoint", "pictures", "charts")
SHOWN = ("pictures", "charts")
"""Phases that take most of the time; a run that is not to be stopped in one of them lacks it."""
KINDS = {"SIGKILL": 100, "SIGTERM": 50, "SIGINT": 50, "SIGUSR1": 50, "disk": 20}
"""Kinds of stops, with their trials."""
_BETWEEN = len(PHASES)
_DISK = 64 << 20
"""Size of the disk before it is full [bytes]."""
_PATIENCE = 120
"""Time after which a run is stuck and gets SIGALRM [s]."""


def watch(seen: memoryview, pipe: int) -> None:
    """Show the phase and the actions of this process, and write where phases begin and end."""

    def in_phase(phase: str, owner: Any, name: str) -> None:
        function = getattr(owner, name)

        def call(*arguments: Any, **options: Any) -> Any:
            outer, seen[0] = seen[0], PHASES.index(phase)
            os.write(pipe, bytes([seen[0]]))
            try:
                return function(*arguments, **options)
            finally:
                os.write(pipe, bytes([_BETWEEN]))
                seen[0] = outer

        setattr(owner, name, call)

    def count(schedule: Schedule, **numbers: int) -> None:
        counted(schedule, **numbers)
        seen[1] = schedule.actions

    counted = Schedule.count
    Schedule.count = count  # type: ignore[method-assign, assignment]
    in_phase("start", TrainingRun, "__init__")
    in_phase("start", script, "write_settings")
    in_phase("drive", TrainingRun, "_iterate")
    in_phase("write", SignalReplayBuffer, "extend")
    in_phase("update", TrainingRun, "_update")
    in_phase("evaluation", TrainingRun, "_evaluate")
    in_phase("checkpoint", TrainingRun, "save")
    in_phase("pictures", tracking, "show_policy")
    in_phase("charts", figures, "plot_learning_curve")
    in_phase("charts", charts, "plot_histograms")


class Child:
    """``train.py`` in a child; its output and its scratch files lie two folders above the run."""

    def __init__(self, folder: Path, *shown: str, resume: bool = False) -> None:
        self.seen = memoryview(mmap.mmap(-1, 16)).cast("q")
        self.seen[0] = _BETWEEN
        self.pipe, pipe = os.pipe()
        words = [f"resume={folder}"] if resume else begin(folder, *shown)
        self.process = os.fork()
        if not self.process:
            signal.alarm(_PATIENCE)
            self._run(folder, words, "charts" in shown, pipe)
        os.close(pipe)

    def _run(self, folder: Path, words: list[str], drawn: bool, pipe: int) -> None:
        status: Any = 1
        try:
            log = os.open(folder.parents[1] / "log", os.O_CREAT | os.O_WRONLY | os.O_APPEND)
            os.dup2(log, 1)
            os.dup2(log, 2)
            tempfile.tempdir = str(folder.parents[1] / "scratch")
            os.makedirs(tempfile.tempdir, exist_ok=True)
            if not drawn:
                for module, name in (figures, "plot_learning_curve"), (charts, "plot_histograms"):
                    setattr(module, name, lambda *arguments: None)
            watch(self.seen, pipe)
            files.run_script(lambda: script.train(words))
        except SystemExit as error:
            status = error.code
        except BaseException as error:
            traceback.print_exc()
            status = 128 + signal.SIGINT if isinstance(error, KeyboardInterrupt) else 1
        finally:
            sys.stdout.flush()
            os._exit(status)

    def changes(self) -> Iterator[int]:
        """Yield the number of each phase as it begins, and another one as it ends."""
        while change := os.read(self.pipe, 1):
            yield change[0]

    def wait(self) -> int:
        """Return the exit status, negative after a signal."""
        _, status = os.waitpid(self.process, 0)
        os.close(self.pipe)
        return os.waitstatus_to_exitcode(status)


def begin(folder: Path, *shown: str) -> list[str]:
    """Command line of a run."""
    pictures = 0 if "pictures" in shown else "null"
    return [*SETTINGS, f"tracking.pictures_every={pictures}", f"run_dir={folder}"]


def durations_of(child: Child) -> list[list[float]]:
    """Durations of all occurrences of each phase of a run that goes through [s]."""
    durations: list[list[float]] = [[] for _ in PHASES]
    open_phases: list[tuple[int, float]] = []
    for change in child.changes():
        if change != _BETWEEN:
            open_phases.append((change, time.perf_counter()))
        else:
            phase, begun = open_phases.pop()
            durations[phase].append(time.perf_counter() - begun)
    return durations


def _read_rows(file: Path) -> None:
    """Raise if a table lacks the end of a row."""
    rows = file.read_text().splitlines(keepends=True)
    assert rows[-1].endswith("\n") and len({row.count(",") for row in rows}) == 1


_READERS: dict[str, Callable[[Path], object]] = {
    ".pt": load_safely,
    ".npz": load_policy,
    ".png": lambda file: Image.open(file).load(),
    ".json": lambda file: json.loads(file.read_text()),
    ".csv": _read_rows,
}


def damaged(folder: Path) -> str:
    """Names of files of a run that cannot be read, or were left half written."""
    names = []
    for file in (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"):
        try:
            assert not file.name.startswith(".")
            _READERS.get(file.suffix, str)(file)
        except Exception:
            names.append(file.name)
    return " ".join(names)


def content(folder: Path) -> dict[str, bytes]:
    """What a finished run has, by its name, but for wall-clock times."""
    found = {files.POLICY: (folder / files.POLICY).read_bytes()}
    for name in (files.EPISODES, files.EVALUATIONS, files.UPDATES):
        table = read_table(folder / name).drop(columns=["seconds", "trained_for"], errors="ignore")
        found[name] = table.to_csv().encode()
    logs = [file for file in (folder / files.CSV).rglob("*.csv") if file.parent.name != "time"]
    found |= {str(file.relative_to(folder)): file.read_bytes() for file in logs}
    # What is left of the run before is no part of a run.
    return found | {file.name: b"" for file in folder.glob(files.PREVIOUS)}


def make(kind: str, trial: int, durations: list[list[float]], expected: dict[str, bytes]) -> Any:
    """Stop a run, resume it, and return a row of what was found."""
    rng, aim = np.random.default_rng((*KINDS,).index(kind) * 1000 + trial), trial % len(PHASES)
    # What a run draws on a full disk is part of its end, wherever that is.
    shown = (PHASES[aim], "charts") if kind == "disk" else (PHASES[aim],)
    while True:  # Until the moment is before the end, and the disk is needed after it.
        occurrence = int(rng.integers(len(durations[aim])))
        delay, free = float(rng.random()) * durations[aim][occurrence], int(rng.integers(1 << 19))
        with _disk(kind) as (place, fill):
            folder = place / "disk/run"
            child = Child(folder, *shown)
            for change in child.changes():
                occurrence -= change == aim
                if occurrence < 0:
                    break
            time.sleep(delay)
            phase = (*PHASES, "between")[child.seen[0]]
            if kind == "disk":
                fill(free)
            else:
                os.kill(child.process, signal.Signals[kind])
            # A signal that asks for an end may find the run at its own, which is no failure.
            if (status := child.wait()) == 0 and kind in ("SIGKILL", "disk"):
                continue
            fill(None)
            saved = (folder / files.CHECKPOINT).exists()
            state = load_safely(folder / files.CHECKPOINT)["schedule"] if saved else {"actions": 0}
            row = {"kind": kind, "trial": trial, "phase": phase, "status": status, "saved": saved}
            row["traceback"] = "Traceback" in (place / "log").read_text()
            row["actions"], row["lost"] = child.seen[1], child.seen[1] - state["actions"]
            row["damaged"], row["scratch"] = damaged(folder), len(os.listdir(place / "scratch"))
            row["resumed"] = Child(folder, *shown, resume=saved).wait()
            after = content(folder) if row["resumed"] == 0 else {}
            names = sorted(expected.keys() | after.keys())
            row["differs"] = " ".join(n for n in names if after.get(n) != expected.get(n))
            wanted = (files.CURVE, files.HISTOGRAMS) if "charts" in shown else ()
            row["missing"] = " ".join(name for name in wanted if not (folder / name).exists())
            return row | {"damaged_after": damaged(folder)}


@contextmanager
def _disk(kind: str) -> Iterator[tuple[Path, Callable[[int | None], None]]]:
    """Yield a new folder, and what leaves so many bytes free in its ``disk``, or None for all."""

    def fill(free: int | None) -> None:
        if kind == "disk":
            size = _DISK if free is None else shutil.disk_usage(disk).used + free
            subprocess.run(["mount", "-o", f"remount,size={size}", disk], check=True)

    with tempfile.TemporaryDirectory(prefix="stop-") as place:
        disk = Path(place, "disk")
        disk.mkdir()
        if kind == "disk":
            subprocess.run(["mount", "-t", "tmpfs", "none", disk], check=True)
        try:
            fill(None)
            yield Path(place), fill
        finally:
            if kind == "disk":
                subprocess.run(["umount", disk], check=True)


def report(rows: pd.DataFrame) -> str:
    """Return the table of the results, in Markdown."""
    lines = [
        "| stop | runs | at | most actions lost | resumed to the same numbers | torn files |",
        "|---|---|---|---|---|---|",
    ]
    for kind, of_kind in rows.groupby("kind", sort=False):
        at = ", ".join(f"{name} {n}" for name, n in of_kind.phase.value_counts().items())
        faults = of_kind[["differs", "missing", "damaged_after"]]
        equal = (of_kind.resumed == 0) & faults.isna().all(axis=1)
        # Those that a next save removes have a dot before their name.
        torn = of_kind.damaged.fillna("").str.contains(r"(?:^| )[^. ]").sum()
        lines.append(
            f"| {kind} | {len(of_kind)} | {at} | {of_kind.lost.max()} | {equal.sum()} | {torn} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the trials that are not in the rows yet, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS], default=[*KINDS])
    parser.add_argument("--trials", type=int, help="of each kind, instead of its usual number")
    parser.add_argument("--rows", type=Path, default=ROWS, help="CSV file, which is continued")
    chosen = parser.parse_args(arguments)
    rows = read_table(chosen.rows)
    done = set(zip(rows.kind, rows.trial, strict=True)) if len(rows) else set()
    numbers = {k: KINDS[k] if chosen.trials is None else chosen.trials for k in chosen.kinds}
    trials = {(kind, trial) for kind, count in numbers.items() for trial in range(count)} - done
    with tempfile.TemporaryDirectory(prefix="stops-") as place:
        if trials:
            # The run of this process compiles all; runs of its children must equal it.
            first, whole = Path(place, "first"), Path(place, "whole/run")
            script.train(begin(first, *SHOWN))
            child, expected = Child(whole, *SHOWN), content(first)
            durations = durations_of(child)
            if child.wait() or content(whole) != expected:
                raise RuntimeError("a run of a child differs from that of a new process")
        for kind, trial in sorted(trials, key=lambda t: (t[1], t[0])):
            row = make(kind, trial, durations, expected)
            rows = pd.concat([rows, pd.DataFrame([row])], ignore_index=True)
            write_table(rows, chosen.rows)
    print(report(read_table(chosen.rows)))


if __name__ == "__main__":
    main()
