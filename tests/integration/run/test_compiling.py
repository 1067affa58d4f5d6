"""Which runs compile their updates, whatever was compiled before."""

from __future__ import annotations

import pytest

from training.run import assembly
from training.run.assembly import is_compiled
from training.settings.command_line import composed
from training.settings.train import register


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
