"""Plugins: what they register works wherever a built-in name does, and comes back with a run."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

import compare
import train
from tests.integration.tiny_runs import OVERRIDES, rows, stop_after, tiny
from tests.integration.tiny_runs import go_on as train_on
from tests.integration.tiny_runs import train as train_tiny
from torchrl_mpfa.methods import METHODS, OwnSignals, register_signal
from training import files
from training.comparison.jobs import Evaluation, Job
from training.plugins import load_plugin, with_plugin
from training.run.checkpoints import read_checkpoint
from training.settings.checks import check_settings
from training.settings.command_line import composed, known_settings
from training.settings.train import register

MINE = """
import torch
from torch import nn
from mpfa_envs import ROBOTS, Cylinder, World, register_generator
from torchrl_mpfa.methods import METHODS, Scaled, register_signal

class Size(nn.Module):
    def __init__(self):
        super().__init__()
        self.factor = nn.Parameter(torch.rand(1))
    def forward(self, learner, batch):
        self.factor.data *= 1.01  # It learns.
        return (self.factor * batch["observation"].norm(dim=-1)).detach()

def pillars(source, difficulty):
    places = [(source.uniform(-3, 3), source.uniform(-3, 3)) for _ in range(4)]
    return World(name="pillars", cylinders=tuple(Cylinder(*p, 0.2) for p in places))

register_signal("size", Size)
register_generator("pillars", pillars)
METHODS["mine"] = Scaled("mine", signals=["td_error", "size"])
ROBOTS["cart"] = ROBOTS["turtlebot2"]
"""


@pytest.fixture
def mine(tmp_path: Path) -> Iterator[Path]:
    """A plugin, of which nothing stays."""
    file = tmp_path / "mine_of_a_test.py"
    file.write_text(MINE)
    yield file
    sys.modules.pop(file.stem, None)
    known_settings.cache_clear()


def tiny_run(mine: Path) -> list[str]:
    own = ["method=mine", "environment.robot=cart", "actions=60"]
    return [*OVERRIDES, *own, "curriculum.stages=[{world: pillars}]", f"plugin={mine}"]


def test_names_of_a_plugin_are_those_of_a_run(mine: Path, tmp_path: Path) -> None:
    words, path = with_plugin(["seed=3", "--plugin", str(mine)])
    assert words == ["seed=3", f"plugin={mine}"] and path == str(mine)
    (other := mine.with_name("other_of_a_test.py")).write_text("")
    with pytest.raises(ValueError, match=r"plugin must be one file, got .*mine.* and .*other"):
        with_plugin([f"plugin={mine}"], str(other))
    sys.modules.pop(other.stem)
    register()
    (settings,) = composed([*tiny_run(mine), "seed=3"])
    run = train_tiny(tmp_path / "run", settings)
    assert run.schedule.actions == 60
    assert run.buffer.stats()["share/size"] > 0


def test_a_run_with_a_signal_of_a_class_resumes_bit_for_bit(mine: Path, tmp_path: Path) -> None:
    load_plugin(mine)
    register()
    settings = tiny("per", robots=2)
    settings.method = replace(METHODS["mine"], capacity=30, batch_size=8)
    check_settings(settings)
    whole = train_tiny(tmp_path / "whole", settings)
    stopped = stop_after(30, tmp_path / "parts", settings)
    torch.manual_seed(99)
    resumed = train_on(tmp_path / "parts", settings)
    assert stopped.actions < whole.actions
    assert rows(resumed) == rows(whole)
    one, other = (run.signals.state_dict()["size"]["factor"] for run in (whole, resumed))
    assert one.equal(other)
    # And it is of this run: another seed, another factor.
    settings.seed = 4
    assert (
        not train_tiny(tmp_path / "other", settings)
        .signals.state_dict()["size"]["factor"]
        .equal(one)
    )


def run_script(monkeypatch: pytest.MonkeyPatch, *words: str) -> object:
    monkeypatch.setattr(sys, "argv", ["train.py", *words])
    try:
        train.main()
    except SystemExit as end:
        return end.code
    return 0


def test_a_resumed_run_asks_for_its_plugin_and_warns_of_another(
    mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    assert run_script(monkeypatch, *tiny_run(mine), f"run_dir={folder}") == 0
    digest = files.digest(mine)
    assert read_checkpoint(folder)["plugin"] == digest
    assert digest in (folder / files.SETTINGS).read_text()
    capsys.readouterr()
    assert run_script(monkeypatch, f"resume={folder}", "actions=70") == 2
    assert f"the run was made with a plugin: add plugin={mine}" in capsys.readouterr().err
    again = f"resume={folder}", "--plugin", str(mine)
    assert run_script(monkeypatch, *again, "actions=70") == 0
    assert "warning" not in capsys.readouterr().err
    mine.write_text(MINE + "\n")
    assert run_script(monkeypatch, *again, "actions=80") == 0
    assert "the plugin has changed since the run was saved" in capsys.readouterr().err


def test_a_comparison_gives_its_plugin_to_every_command(mine: Path, tmp_path: Path) -> None:
    words = ["--plugin", str(mine), "--methods", "mine", "--folder", str(tmp_path / "cmp")]
    options = compare.parse([*words, "--", *OVERRIDES])
    assert options.overrides[-1] == f"plugin={mine}"
    job = Job("ddpg", "mine", 0, tmp_path)
    assert f"plugin={mine}" in job.trains(options.overrides)
    job.path.mkdir()
    (job.path / files.CHECKPOINT).touch()
    assert job.trains(options.overrides)[1:] == [f"resume={job.path}", f"plugin={mine}"]
    asked = Evaluation(("A",), 1, plugin=options.plugin)
    assert job.evaluates(asked)[-2:] == ["--plugin", str(mine)]
    (job.path / files.SETTINGS).write_text('{"plugin_sha256": "of another version"}')
    register()
    assert job.differences(job.asked(options.overrides)) == ["another plugin than the present one"]


@pytest.mark.parametrize(
    ("name", "code", "message"),
    [
        ("nowhere.py", None, "plugin must be a Python file, got .*nowhere.py"),
        ("wrong.py", "x = 1\n1 / 0\n", r"plugin .*wrong.py:2: ZeroDivisionError: division by zero"),
        ("wrong.py", "x =\n", "SyntaxError"),
        ("torch.py", "", "must have a name that no module has"),
        (
            "wrong.py",
            "from torchrl_mpfa.methods import METHODS, Method\nMETHODS['mine'] = Method('yours')",
            r"METHODS\['mine'\] must have this name, got 'yours'",
        ),
        (
            "wrong.py",
            "from torchrl_mpfa.methods import register_signal\nregister_signal('td_error', len)",
            "name must be one that no loss has, got 'td_error'",
        ),
    ],
)
@pytest.mark.usefixtures("mine")
def test_what_is_no_plugin_is_one_line(
    name: str, code: str | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / name
    if code is not None:
        file.write_text(code)
    with pytest.raises(ValueError, match=message):
        load_plugin(file)
    with pytest.raises(SystemExit):
        compare.parse(["--plugin", str(file)])


def test_a_signal_of_another_shape_is_rejected_by_name(mine: Path) -> None:
    register_signal("half", lambda learner, batch: batch["x"][:4])
    own = OwnSignals(["half", "td_error"])
    with pytest.raises(ValueError, match=r"signal 'half' must have shape \[8\], got \[4\]"):
        own.write(None, TensorDict({"x": torch.zeros(8)}, [8]))
    with pytest.raises(TypeError, match="signal must be a function or a class, got 3"):
        register_signal("three", 3)  # type: ignore[arg-type]
