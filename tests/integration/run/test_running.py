"""The process of a run: what it is set to, and what it says when it cannot go on."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from torch._inductor.exc import InductorError
from torch.utils import cpp_extension

from tests.integration.tiny_runs import OVERRIDES, tiny, train
from torchrl_mpfa import Learner
from training.files import CHECKPOINT
from training.run import assembly, loop
from training.run.assembly import is_compiled, make_learner
from training.run.loop import TrainingRun
from training.run.script import Rejected, prepare_process, start
from training.settings.command_line import composed
from training.settings.train import TrainSettings, register


def begin(folder: Path) -> int:
    (settings,) = composed([*OVERRIDES, "curriculum.stages=[{world: A, episodes: 3}]"])
    return start(settings, folder)


def test_training_treats_denormal_numbers_as_zero() -> None:
    threads, least = torch.get_num_threads(), torch.finfo(torch.float32).tiny
    try:
        prepare_process(TrainSettings(threads=1))
        assert (torch.tensor([least]) / 2).item() == 0.0
    finally:
        torch.set_flush_denormal(False)
        torch.set_num_threads(threads)
    assert (torch.tensor([least]) / 2).item() > 0.0


def test_no_program_is_compiled_to_see_which_instructions_the_compiler_knows() -> None:
    options = torch._inductor.config.cpp
    before = options.vec_isa_ok
    try:
        for given, expected in ((None, True), (False, False)):
            options.vec_isa_ok = given
            prepare_process(TrainSettings(threads=1))
            assert options.vec_isa_ok is expected
    finally:
        # By hand: monkeypatch would leave PyTorch without this option.
        options.vec_isa_ok = before


@pytest.mark.skipif(torch.cuda.is_available(), reason="with a GPU PyTorch does not warn")
def test_a_cuda_toolkit_without_a_gpu_is_not_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warned: list[str] = []
    logger = logging.getLogger("torch.utils.cpp_extension")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    monkeypatch.setattr(logger, "handle", lambda record: warned.append(record.getMessage()))
    prepare_process(TrainSettings(threads=1))
    assert cpp_extension._find_cuda_home() == str(tmp_path)
    assert warned == []


def test_a_run_says_once_that_it_compiles_its_update(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def eager(*arguments: Any, **options: Any) -> Learner:
        return make_learner(*arguments, **{**options, "compile": False})

    monkeypatch.setattr(loop, "make_learner", eager)
    settings = tiny()
    for compiles in (False, True):
        settings.learner.compile = compiles
        train(tmp_path / str(compiles), settings)
        assert capsys.readouterr().out.count("compiling the update, some 20 s") == compiles


COMPILER = "InvalidCxxCompiler: No working C++ compiler found"


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            InductorError(RuntimeError(COMPILER), None),
            r"the update could not be compiled, .*: install a C\+\+ compiler .*compile=false$",
        ),
        (MemoryError(), "not enough memory for method.capacity, learner.width"),
        (
            RuntimeError(
                "[enforce fail] can't allocate memory: you tried to allocate 9 bytes.\nat"
            ),
            r"not enough memory for .* \(you tried to allocate 9 bytes.\)$",
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_run_that_the_machine_ends_says_so_in_one_sentence_and_is_status_1(
    error: Exception,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(TrainingRun, "_iterate", fails)
        with pytest.raises(SystemExit) as ended:
            begin(tmp_path)
    assert ended.value.code == 1
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "train.py" in line)
    assert re.search(message, line)
    assert (tmp_path / CHECKPOINT).exists()
    if isinstance(error, MemoryError | RuntimeError):
        # Before the first step it is a setting that cannot be.
        monkeypatch.setattr(TrainingRun, "_build", fails)
        with pytest.raises(Rejected, match=message):
            begin(tmp_path / "other")


def test_an_error_of_the_program_is_no_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_: TrainingRun) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr(TrainingRun, "_iterate", fails)
    with pytest.raises(RuntimeError, match="a bug"):
        begin(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "compiled"),
    [
        ("", True),
        ("curriculum.stages=[{world:A,actions:20000}]", True),
        ("curriculum.stages=[{world:A,actions:19999}]", False),
        ("curriculum.stages=[{world:A,actions:100}] learner.compile=true", True),
        ("learner.compile=false", False),
        ("learner=sac", True),
        ("learner=dqn", False),
        ("regime=paper", True),
        ("regime=paper curriculum=A", True),
        ("regime=paper curriculum.stages=[{world:A,episodes:49}]", False),
    ],
)
def test_a_run_is_compiled_by_its_settings_and_length(
    arguments: str, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(assembly, "has_compiler", lambda: True)
    register()
    (settings,) = composed(["environment.physics=kinematic", *arguments.split()])
    assert is_compiled(settings) == compiled


def test_without_a_compiler_a_long_run_says_that_it_is_eager(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    register()
    (settings,) = composed([])
    monkeypatch.setenv("CXX", "/nonexistent")
    assert not is_compiled(settings)
    assert "there is no C++ compiler" in capsys.readouterr().out
