"""Runs TorchRL's own replay tests with the parts of this package in the place of theirs.

``python -m tests.upstream CHECKOUT``, where CHECKOUT is one of https://github.com/pytorch/rl of
about the installed version, prints a table: what passes with TorchRL's parts, what with ours, and
which tests differ. What differs on purpose stands in docs/results/upstream.md.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

SUITES = {
    "prioritized": ["test/rb/test_prioritized.py"],
    "samplers": [
        "test/rb/test_samplers.py",
        "-k",
        "prb or prioritized or SignalSampler or MPFASampler or TreeSampler",
    ],
    "composable": [
        "test/rb/test_composable.py::TestComposableBuffers",
        "-k",
        "(PrioritizedSampler or SignalSampler or MPFASampler or TreeSampler) and tensordict and "
        "(LazyTensorStorage or SignalTensorStorage) and not recompile",
    ],
    "storages": [
        "test/rb/test_storages.py::TestStorages",
        "test/rb/test_storages.py::TestLazyStorages",
        "-k",
        "not compile",
    ],
}
"""Tests of each suite, as arguments of pytest; names of classes are part of the tests' names."""

PLACES = (
    "torchrl.data",
    "torchrl.data.replay_buffers",
    "torchrl.data.replay_buffers.samplers",
    "torchrl.data.replay_buffers.storages",
    "torchrl.data.replay_buffers.replay_buffers",
    "torchrl.data.replay_buffers.replay_buffers.prioritized",
    "torchrl.data.replay_buffers.replay_buffers.prioritized_tensordict",
)
"""Modules that the tests, and TorchRL's ready-made prioritized buffers, take the parts from."""

_STORAGES = {
    "LazyTensorStorage": "SignalTensorStorage",
    "LazyMemmapStorage": "SignalMemmapStorage",
}
KINDS: dict[str, dict[str, str]] = {
    "TorchRL": {},
    "SignalSampler": {"PrioritizedSampler": "SignalSampler", **_STORAGES},
    "MPFASampler": {"PrioritizedSampler": "MPFASampler", **_STORAGES},
    "SignalReplayBuffer": {
        "PrioritizedSampler": "SignalSampler",
        "TensorDictReplayBuffer": "SignalReplayBuffer",
        **_STORAGES,
    },
    "TreeSampler": {
        "PrioritizedSampler": "TreeSampler",
        "TensorDictReplayBuffer": "SignalReplayBuffer",
        **_STORAGES,
    },
}
"""What stands in the place of what, by the name of the column."""

_KIND, _OUTCOMES = "MPFA_UPSTREAM_KIND", "MPFA_UPSTREAM_OUTCOMES"


def pytest_configure() -> None:
    """Put our parts in the place of theirs, before any test imports them."""
    places = ("torchrl_mpfa", "torchrl_mpfa.samplers.prioritized")
    ours = [importlib.import_module(place) for place in places]
    for name, replacement in KINDS[os.environ[_KIND]].items():
        for place in PLACES:
            module = importlib.import_module(place)
            if hasattr(module, name):
                part = next(
                    getattr(each, replacement) for each in ours if hasattr(each, replacement)
                )
                setattr(module, name, part)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Write down what came of each test."""
    if report.when == "call" or report.outcome != "passed":
        with open(os.environ[_OUTCOMES], "a", encoding="utf-8") as file:
            file.write(json.dumps([report.nodeid, report.outcome]) + "\n")


def run_suite(checkout: Path, suite: str, kind: str) -> dict[str, str]:
    """Whether each test of a suite passed, failed or was skipped with one kind of parts."""
    with tempfile.TemporaryDirectory() as folder:
        outcomes = Path(folder) / "outcomes"
        outcomes.touch()
        root = str(Path(__file__).resolve().parents[1])
        paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {
            **os.environ,
            _KIND: kind,
            _OUTCOMES: str(outcomes),
            "PYTHONPATH": os.pathsep.join(paths),
        }
        chosen = [str(checkout / each) if "/" in each else each for each in SUITES[suite]]
        command = [sys.executable, "-m", "pytest", "-q", "--tb=line", "-o", "addopts="]
        subprocess.run(
            [
                *(*command, "-p", "no:cacheprovider", "-p", "tests.upstream"),
                *(f"--rootdir={checkout}", *chosen),
            ],
            # Not in the checkout, whose torchrl, without its compiled part, would be imported.
            cwd=folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            check=False,
        )
        lines = outcomes.read_text(encoding="utf-8").splitlines()
    named_as_theirs = {ours: theirs for theirs, ours in KINDS[kind].items()}
    found = {}
    for line in lines:
        name, outcome = json.loads(line)
        for ours, theirs in named_as_theirs.items():
            name = name.replace(ours, theirs)
        found[name] = outcome
    return found


def main() -> None:
    """Run all suites with all kinds of parts and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkout", type=Path, help="a checkout of pytorch/rl")
    parser.add_argument("--suites", nargs="+", choices=SUITES, default=list(SUITES))
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS)[1:], default=list(KINDS)[1:])
    arguments = parser.parse_args()
    if not (arguments.checkout / "test/rb").is_dir():
        parser.error(f"{arguments.checkout} is no checkout of pytorch/rl: it has no test/rb")
    checkout = arguments.checkout.resolve()
    differences: dict[str, list[str]] = {}
    sys.stdout.write(" | ".join(["| suite", "TorchRL", *arguments.kinds]) + " |\n")
    sys.stdout.write("|---" * (2 + len(arguments.kinds)) + "|\n")
    for suite in arguments.suites:
        stock = run_suite(checkout, suite, "TorchRL")
        passed = {name for name, outcome in stock.items() if outcome == "passed"}
        if not passed:
            parser.error(f"none of the tests of {suite!r} passes with TorchRL's own parts")
        cells = [f"| {suite}", str(len(passed))]
        for kind in arguments.kinds:
            found = run_suite(checkout, suite, kind)
            lost = sorted(name for name in passed if found.get(name) != "passed")
            cells.append(f"{len(passed) - len(lost)} of {len(passed)}")
            for name in lost:
                differences.setdefault(name, []).append(kind)
        sys.stdout.write(" | ".join(cells) + " |\n")
        sys.stdout.flush()
    for name, kinds in differences.items():
        sys.stdout.write(f"{name}: {', '.join(kinds)}\n")


if __name__ == "__main__":
    main()
