"""What holds for all tests: no log lines of TorchRL, one thread, a fixed global seed."""

import gc
import os
import sys
from collections.abc import Generator
from importlib.util import find_spec

import pytest

# Also for the processes that tests start: two of them and two of pytest's on two cores.
os.environ["OMP_NUM_THREADS"] = "1"
# TorchRL tells of every storage that it allocates.
os.environ["RL_LOGGING_LEVEL"] = "WARNING"


BULLET = find_spec("pybullet") is not None
"""Python 3.12 and later have no PyBullet, hence no wheels."""
if not BULLET:
    collect_ignore = [  # What they import needs it.
        "benchmarks/test_speed.py",
        "envs/test_environment_benchmark.py",
        "envs/test_lidar.py",
        "envs/test_robot.py",
        "envs/test_simulation_release.py",
        "integration/test_commands.py",
    ]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Skip what fails because PyBullet is not there; without wheels nothing asks for it."""
    report = yield
    said = report.longreprtext + report.capstdout + report.capstderr
    wanting = ("physics='wheels' needs PyBullet", "No module named 'pybullet'")
    if report.failed and not BULLET and any(words in said for words in wanting):
        report.outcome = "skipped"
        report.longrepr = (*report.location[:2], "PyBullet has wheels for Python 3.11 and earlier")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Leave what is imported out of garbage collections, each of which would take 0.3 s of it."""
    gc.disable()
    found = yield
    gc.collect()
    gc.freeze()
    gc.enable()
    return found


def pytest_unconfigure() -> None:
    """Let Python free at its end what was imported, which Triton would else report as leaks."""
    gc.unfreeze()


# PyTorch takes seconds to import, and of the processes of pytest-xdist the first runs no test.
@pytest.fixture
def reconstructed(monkeypatch):
    """The reconstructed methods of the paper's table by name, as their plugin registers them."""
    from benchmarks.paper.methods import RECONSTRUCTIONS
    from torchrl_mpfa.methods import METHODS

    for name, method in RECONSTRUCTIONS.items():
        monkeypatch.setitem(METHODS, name, method)


@pytest.fixture(autouse=True)
def one_thread():
    """TorchRL's parallel environments leave more, and tiny operations then wait for each other."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def fixed_seed():
    """Networks start from torch's global generator; every test starts it at the same place."""
    import torch

    # torch.manual_seed would also keep a traceback for each accelerator that is not there.
    torch.default_generator.manual_seed(0)
    if torch.cuda.is_available():
        torch.cuda.manual_seed_all(0)


REGISTRIES = (
    ("torchrl_mpfa.methods", "METHODS"),
    ("torchrl_mpfa.methods.registered", "SIGNALS"),
    ("mpfa_envs", "ROBOTS"),
    ("mpfa_envs", "SENSORS"),
    ("mpfa_envs", "REWARDS"),
    ("mpfa_envs.generators.generate", "_registered"),
)


@pytest.fixture(autouse=True)
def registries():
    """What a test registers, or a page or plugin that it runs, is gone afterwards."""
    found = [
        getattr(sys.modules[module], name) for module, name in REGISTRIES if module in sys.modules
    ]
    before = [dict(registry) for registry in found]
    yield
    for registry, names in zip(found, before, strict=True):
        if registry != names:
            registry.clear()
            registry.update(names)
