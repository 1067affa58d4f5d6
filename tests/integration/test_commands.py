"""The commands on the pages are ones that the scripts understand: none of them is run."""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

import compare
import ddpg
import evaluate
import export
import gymnasium_td3
import ir_sim
import play
import recurrent_td3
import report
import sb3_replay
import stable_baselines
import torchrl_ddpg
import torchrl_maddpg
import torchrl_sac
import torchrl_trainer
import tune
from benchmarks import drivers, people, pictures, rivals, sampling, stops
from benchmarks.late import __main__ as late
from benchmarks.paper import __main__ as paper
from benchmarks.speed import environment, worlds
from benchmarks.values import __main__ as values
from mpfa_envs import REWARDS, SENSORS, LidarSensor, navigation_reward
from torchrl_mpfa.methods import METHODS, Scaled
from training.plugins import with_plugin
from training.settings.command_line import parse_overrides
from training.worlds import parse_worlds

ROOT = Path(__file__).parents[2]
PAGES = ["README.md", "CONTRIBUTING.md", *(p.relative_to(ROOT) for p in ROOT.glob("docs/**/*.md"))]
OTHERS = ("make", "pip", "python3", "ray", "ros2", "source", "wandb")
"""Programs that are not ours."""
SHELL = (
    'python() { printf "%s\\n" "$@"; echo "--end--"; }; '
    + "".join(f"{name}() {{ :; }}; " for name in OTHERS)
    + "set -e; "
)
"""Prints the words of each command after ``python``, in place of running it."""


MAINS: dict[str, Callable[[], object]] = {
    "compare": compare.main,
    "ddpg": ddpg.main,
    "evaluate": evaluate.main,
    "export": export.main,
    "play": play.main,
    "recurrent_td3": recurrent_td3.main,
    "report": report.main,
    "gymnasium_td3": gymnasium_td3.main,
    "ir_sim": ir_sim.main,
    "sb3_replay": sb3_replay.main,
    "stable_baselines": stable_baselines.main,
    "torchrl_ddpg": torchrl_ddpg.main,
    "torchrl_maddpg": torchrl_maddpg.main,
    "torchrl_sac": torchrl_sac.main,
    "torchrl_trainer": torchrl_trainer.main,
    "tune": tune.main,
    "benchmarks.speed.environment": environment.main,
    "benchmarks.speed.worlds": worlds.main,
    "benchmarks.values": values.main,
    "benchmarks.paper": paper.main,
    "benchmarks.stops": stops.main,
    "benchmarks.drivers": drivers.main,
    "benchmarks.late": late.main,
    "benchmarks.people": people.main,
    "benchmarks.pictures": pictures.main,
    "benchmarks.rivals": rivals.main,
    "benchmarks.sampling": sampling.main,
}


class Parsed(Exception):
    """Raised once a script has read its command line."""


def scripts(text: str) -> Iterator[str]:
    """The blocks of a page that one would paste into a shell."""
    yield from re.findall(r"^```bash\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    plain = re.sub(r"^( *)(```+).*?^\1\2", "", text, flags=re.DOTALL | re.MULTILINE)
    for block in re.findall(r"(?:^    .*\n)+", plain, re.MULTILINE):
        if re.search(r"^ +(?:\.venv/bin/)?python ", block, re.MULTILINE):
            yield block


def commands() -> list[tuple[str, ...]]:
    """Words after ``python`` of all commands on the pages, each once."""
    texts = [(ROOT / page).read_text(encoding="utf-8") for page in PAGES]
    code = "".join(f"({block.replace('.venv/bin/', '')})\n" for t in texts for block in scripts(t))
    shell = subprocess.run(["sh", "-c", SHELL + code], capture_output=True, text=True, check=False)
    assert (shell.returncode, shell.stderr) == (0, "")
    found = [tuple(words.splitlines()) for words in shell.stdout.split("--end--\n")]
    return sorted({words for words in found if words})


def main_of(words: Sequence[str]) -> tuple[str, list[str]]:
    """The script or module of a command, and what follows it."""
    if words[0] == "-m":
        return words[1], list(words[2:])
    assert (ROOT / words[0]).exists()
    return Path(words[0]).stem, list(words[1:])


def understand(words: Sequence[str]) -> None:
    """Let a script read its command line, and no more."""
    script, arguments = main_of(words)
    if script == "train":
        parse_overrides(with_plugin(arguments)[0])
        return
    sys.argv = [script, *arguments]
    with pytest.raises(Parsed) as found:
        MAINS[script]()
    options = found.value.args[0]
    if script == "compare":
        parse_overrides(options.overrides)
    if script == "tune":
        parse_overrides(options.settings)
    # Teams have worlds of their own.
    if script in ("compare", "evaluate") and getattr(options, "team", 1) == 1:
        files = ".yaml", ".zip"
        known = [word for word in options.worlds if not word.endswith(files)]
        assert len(parse_worlds(known)) >= len(known)


@pytest.mark.usefixtures("reconstructed")
def test_every_command_on_the_pages_is_understood(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # What a search leaves is read with the command line.
    best = tmp_path / "runs/tune/best.yaml"
    best.parent.mkdir(parents=True)
    best.write_text("learner.tau: 0.01\n")
    for name in ("benchmarks", "docs", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    # Pages name a plugin, which registers a method, sensors and a reward.
    Path("mine.py").write_text("")
    monkeypatch.setitem(METHODS, "mine", Scaled("mine", signals=["td_error"]))
    for name in ("rear", "compass"):
        monkeypatch.setitem(SENSORS, name, LidarSensor())
    monkeypatch.setitem(REWARDS, "careful", navigation_reward)
    for name in ("mine", "reconstructions"):
        monkeypatch.setitem(sys.modules, name, None)  # Leaves with the test.
    parse = argparse.ArgumentParser.parse_args

    def parsed(self: argparse.ArgumentParser, *arguments: Any) -> None:
        raise Parsed(parse(self, *arguments))

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parsed)
    monkeypatch.setattr(sys, "argv", [])
    found = commands()
    assert len(found) > 80
    wrong = {}
    for words in found:
        try:
            understand(words)
        except (Exception, SystemExit) as error:
            wrong[" ".join(words)] = str(error) + capsys.readouterr().err
    assert wrong == {}
