"""CPU time of a process until it can begin: to import the package, and to print the help."""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.speed.timing import Entry, entry, report_progress

_TRAIN = Path(__file__).parents[2] / "examples" / "train.py"
COMMANDS: dict[str, list[str]] = {
    "import_torchrl": ["-c", "import torch, torchrl, tensordict"],
    "import_package": ["-c", "import torch, torchrl, tensordict, torchrl_mpfa"],
    "import_buffer": ["-c", "from torchrl_mpfa import SignalReplayBuffer"],
    "train_help": [str(_TRAIN), "--help"],
}
"""Arguments of Python; the first is what the others are compared with."""


def measure(*, quick: bool) -> list[Entry]:
    """Run each command some times in turn; medians have ratios to the first command."""
    found: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for _ in range(1 if quick else 5):
        for name, arguments in COMMANDS.items():
            found[name].append(_seconds(arguments))
    times = {name: statistics.median(each) for name, each in found.items()}
    base, *others = times
    entries = [entry(base, times[base], "s")]
    for name in others:
        ratio = times[name] / times[base]
        report_progress(f"{name}: {times[name]:.2f} s of CPU time, {ratio:.2f} of {base}")
        entries.append(entry(name, times[name], "s", ratio=ratio, baseline=base))
    return entries


def _seconds(arguments: Sequence[str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
