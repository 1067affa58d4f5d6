"""Compilation of the update of a run."""

from __future__ import annotations

import os
import shutil
import sysconfig
from pathlib import Path

import torch._inductor.config as inductor
from tqdm import tqdm

from training.settings.learners import is_discrete
from training.settings.train import TrainSettings

_MANY_UPDATES = 5_000
"""From here on a program saves more than it takes to make one."""
_EPISODE = 100
"""Actions that an episode is counted as, of a run whose stages count episodes."""


def is_compiled(settings: TrainSettings) -> bool:
    """Return True if the update is compiled: as asked for, or by the length of the run alone.

    So a seed gives the same bits whatever was compiled before.
    """
    wanted = settings.learner.compile
    if wanted != "auto":
        return bool(wanted)
    stages = settings.curriculum.stages
    actions = sum(stage.actions + _EPISODE * stage.episodes for stage in stages)
    long = actions // settings.robots * settings.updates >= _MANY_UPDATES
    if not long or is_discrete(settings.learner):
        return False
    if not has_compiler():
        tqdm.write("updates take twice as long: there is no C++ compiler, or no headers of Python")
        return False
    return True


def has_compiler() -> bool:
    """Return True if there are a C++ compiler and the headers of Python."""
    headers = Path(sysconfig.get_path("include"), "Python.h")
    return headers.exists() and shutil.which(os.environ.get("CXX", "g++")) is not None


def prepare_compiler() -> None:
    """Set PyTorch's compiler for a few small programs on a CPU."""
    # Threads wait for the C++ compiler. Further processes, to compile programs of a GPU, would
    # be started for nothing.
    os.environ.setdefault("TORCH_WARM_POOL", "0")
    # It need not compile a program for each set of vector instructions that the processor has, a
    # quarter of the time: a compiler that takes PyTorch's C++20 knows them.
    if inductor.cpp.vec_isa_ok is None:
        inductor.cpp.vec_isa_ok = True
