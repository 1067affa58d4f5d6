"""The comparison: what is trained, what is left alone, what goes on, and what is kept of it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

import compare
import evaluate
from mpfa_envs import Policy, load_policy, save_policy
from tests.integration.tiny_runs import OVERRIDES
from training import figures, files
from training.comparison import execution
from training.comparison.arms import parse_arm, with_defaults
from training.comparison.jobs import Evaluation, Job, other_than_asked
from training.comparison.workers import Lost
from training.records import read_table
from training.run import script
from training.run.script import Rejected, resume, start
from training.settings.command_line import composed

EPISODES = "curriculum.stages=[{{world: A, episodes: {}}}]"


def comparison(
    folder: Path, *more: str, methods: tuple[str, ...] = ("mpfa_per", "uniform"), length: int = 2
) -> list[str]:
    return [
        *("--folder", str(folder), "--methods", *methods, "--seeds", "0"),
        *("--worlds", "B", "rooms:7-8", "--episodes", "2", *more),
        *("--", *OVERRIDES, EPISODES.format(length)),
    ]


class InThisProcess:
    """Does what a worker would, without the seconds that one takes to start."""

    def ready(self) -> bool:
        return True

    def start(self, command: Sequence[str], log: Path) -> None:
        arguments = list(command[1:])
        if command[0].endswith("evaluate.py"):
            evaluate.main(arguments)
            self.status = 0
            return
        try:
            if arguments[0].startswith("resume="):
                self.status = resume(Path(arguments[0].removeprefix("resume=")), [])
            else:
                (settings,) = composed(arguments)
                self.status = start(settings, Path(settings.run_dir))
        except Rejected as error:
            log.write_text(str(error))
            self.status = 2

    def ended(self) -> int:
        return self.status

    def stop(self) -> None:
        pass

    wait = stop


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execution, "LocalWorker", InThisProcess)
    monkeypatch.setattr(execution, "_PAUSE", 0.0)
    # A picture of a run takes longer than the two episodes of one.
    monkeypatch.setattr(figures, "plot_learning_curve", lambda *_: None)


@pytest.mark.usefixtures("in_this_process")
def test_a_comparison_keeps_every_episode_and_rejects_other_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare.main(comparison(tmp_path)) == 0
    found = read_table(tmp_path / files.EPISODES)
    worlds = ["B", "B", "rooms-7", "rooms-7", "rooms-8", "rooms-8"]
    assert list(found["world"]) == worlds * 2
    assert list(found["method"]) == ["mpfa_per"] * 6 + ["uniform"] * 6
    assert set(found["physics"]) == {"kinematic"}
    assert found["arm"].isna().all()
    assert (found["success"] ^ found["collision"] ^ found["timeout"]).all()
    kept = json.loads((tmp_path / files.SETTINGS).read_text())
    assert kept["runs"]["ddpg-uniform-0"]["method"]["name"] == "uniform"
    assert kept["worlds"] == ["B", "rooms:7-8"]
    assert kept["physics"] is None

    # Again: nothing happens.
    checkpoint = tmp_path / "ddpg-mpfa_per-0" / files.CHECKPOINT
    before = checkpoint.stat().st_mtime_ns
    assert compare.main(comparison(tmp_path)) == 0
    assert checkpoint.stat().st_mtime_ns == before
    assert "2 runs, 2 of them done" in capsys.readouterr().out

    # Other settings: rejected by name, nothing touched.
    other = [*comparison(tmp_path, methods=("mpfa_per",)), "method.alpha=0.9"]
    assert compare.main(other) == 2
    message = capsys.readouterr().err
    assert "ddpg-mpfa_per-0 was trained with method.alpha=0.6, asked for is 0.9" in message
    assert checkpoint.stat().st_mtime_ns == before

    # Trained again only if asked to; other pairs are driven without training.
    assert compare.main([*comparison(tmp_path, "--anew", methods=("mpfa_per",)), other[-1]]) == 0
    assert json.loads((checkpoint.parent / files.SETTINGS).read_text())["method"]["alpha"] == 0.9
    before = checkpoint.stat().st_mtime_ns
    more = [*comparison(tmp_path, methods=("mpfa_per",)), other[-1]]
    more[more.index("--episodes") + 1] = "3"
    assert compare.main(more) == 0
    assert len(read_table(tmp_path / files.EPISODES)) == 9
    assert checkpoint.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("setting", "matters"),
    [
        ("evaluation.every=400", True),
        ("threads=2", False),
        ("checkpoint_every=50", False),
        ("tracking.project=other", False),
    ],
)
def test_what_makes_another_run_of_it_is_not_what_a_comparison_asked_for(
    setting: str, matters: bool, tmp_path: Path
) -> None:
    job = Job("ddpg", "per", 0, tmp_path)
    job.path.mkdir()
    many = [*OVERRIDES, "robots=4", EPISODES.format(1)]
    script.write_settings(job.asked(many), job.path / files.SETTINGS)
    assert not other_than_asked([job], many)
    assert (job in other_than_asked([job], [*many, setting])) == matters


@pytest.mark.filterwarnings("ignore:policy learned behind the filter")
@pytest.mark.parametrize(("needs", "asked"), [(True, None), (False, None), (True, False)])
def test_policies_are_evaluated_behind_the_filter_that_they_need_unless_asked_otherwise(
    needs: bool, asked: bool | None, tmp_path: Path
) -> None:
    job = Job("td3", "per", 0, tmp_path)
    job.path.mkdir()
    policy = load_policy("td3-rooms")
    how = {"card": {"filter": needs}, "env_arguments": policy.env_arguments}
    save_policy(Policy(policy.layers, **how), job.path / files.POLICY)
    (job.path / files.EPISODES).write_text("success,world\n")
    (job.path / files.STATUS).write_text('{"finished": true}')
    wanted = Evaluation(("A",), 1, "kinematic", asked)
    assert not job.is_evaluated(wanted)
    evaluate.main(job.evaluates(wanted)[1:])
    assert job.is_evaluated(wanted)
    assert job.results(wanted).name.endswith("-filter") == (needs and asked is None)
    assert not job.is_evaluated(replace(wanted, filtered=not needs if asked is None else True))


@pytest.mark.usefixtures("in_this_process")
def test_arms_are_trained_with_settings_of_their_own_and_told_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arms = ["--arm", "default:", "--arm", "None:method.alpha=0.3,learner.width=4"]
    arguments = comparison(tmp_path, *arms, methods=("per",))
    assert compare.main(arguments) == 0
    found = read_table(tmp_path / files.EPISODES)
    assert list(found["arm"]) == ["default"] * 6 + ["None"] * 6
    kept = json.loads((tmp_path / files.SETTINGS).read_text())["runs"]
    widths = {name: run["learner"]["width"] for name, run in kept.items()}
    assert widths == {"ddpg-per-default-0": 8, "ddpg-per-None-0": 4}
    assert kept["ddpg-per-None-0"]["method"]["alpha"] == 0.3
    capsys.readouterr()
    assert compare.main(arguments) == 0
    assert "2 runs, 2 of them done" in capsys.readouterr().out

    # Of two arms the one that has changed is named.
    arguments[arguments.index(arms[-1])] = "None:method.alpha=0.4,learner.width=4"
    assert compare.main(arguments) == 2
    message = capsys.readouterr().err
    assert "ddpg-per-None-0 was trained with method.alpha=0.3, asked for is 0.4" in message
    arguments[arguments.index("None:method.alpha=0.4,learner.width=4")] = "None:method.alpha=-1"
    assert compare.main(arguments) == 2
    assert "--arm None: method.alpha must be finite" in capsys.readouterr().err


def assert_same_rows(one: Path, other: Path) -> None:
    """Assert that two comparisons have the same episodes, but for the time that they took."""
    found, expected = (
        read_table(folder / files.EPISODES).drop(columns=["plan_s", "decision_s"])
        for folder in (one, other)
    )
    assert found.equals(expected)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def descendants(process: int) -> list[int]:
    """Processes that a process has started, and those that they have."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [found for n in map(int, children) for found in (n, *descendants(n))]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").exists(), reason="children are listed in /proc")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGKILL, -9), (signal.SIGTERM, 143)])
def test_a_killed_comparison_leaves_no_training_behind_and_goes_on_to_the_same_rows(
    number: int, status: int, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    arguments = [*comparison(tmp_path / "killed", methods=("mpfa_per",), length=20)]
    arguments.append("checkpoint_every=20")
    process = subprocess.Popen(
        [sys.executable, compare.__file__ or "", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    checkpoint = tmp_path / "killed" / "ddpg-mpfa_per-0" / files.CHECKPOINT
    deadline = time.monotonic() + 120
    while not checkpoint.exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    started = descendants(process.pid)
    assert len(started) >= 2
    process.send_signal(number)
    assert process.wait() == status
    while any(map(alive, started)):
        assert time.monotonic() < deadline, "a training outlived the comparison"
        time.sleep(0.05)
    # It was stopped: one that nobody stops comes to its end, and is gone as well.
    assert not json.loads((checkpoint.parent / files.STATUS).read_text())["finished"]
    assert not (tmp_path / "killed" / files.EPISODES).exists()

    request.getfixturevalue("in_this_process")
    assert compare.main(arguments) == 0
    arguments[1] = str(tmp_path / "whole")
    assert compare.main(arguments) == 0
    assert_same_rows(tmp_path / "killed", tmp_path / "whole")


def test_a_run_whose_worker_is_gone_goes_on_at_its_last_checkpoint(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    in_this_process: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    commands: list[str] = []

    class OnWorkersThatFail(InThisProcess):
        """Trains and is gone before it says so, then is gone at each evaluation but the last."""

        def start(self, command: Sequence[str], log: Path) -> None:
            commands.append(Path(command[0]).name)
            super().start(command, log)

        def ended(self) -> int:
            if len(commands) < 4:
                raise Lost("worker 7 is gone")
            return super().ended()

    monkeypatch.setattr(execution, "LocalWorker", OnWorkersThatFail)
    assert compare.main(comparison(tmp_path / "lost", methods=("per",))) == 0
    assert commands == ["train.py", *["evaluate.py"] * 3]
    assert capsys.readouterr().out.count("its worker is gone") == 3
    assert not (tmp_path / "lost" / "ddpg-per-0" / files.PREVIOUS).exists()
    monkeypatch.setattr(execution, "LocalWorker", InThisProcess)
    assert compare.main(comparison(tmp_path / "whole", methods=("per",))) == 0
    assert_same_rows(tmp_path / "lost", tmp_path / "whole")

    # A run that takes down whatever it runs on is given up.
    commands.clear()
    monkeypatch.setattr(execution, "MOST_LOSSES", 2)
    monkeypatch.setattr(execution, "LocalWorker", OnWorkersThatFail)
    assert compare.main(comparison(tmp_path / "never", methods=("per",))) == 1
    assert "ddpg-per-0: failed, lost 2 workers" in capsys.readouterr().out


def test_a_comparison_says_what_it_needs_where_there_is_no_ray(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "training.comparison.clusters", raising=False)
    monkeypatch.setitem(sys.modules, "ray", None)
    assert compare.main(comparison(tmp_path, "--ray")) == 2
    assert (
        "--ray needs Ray: install the extra 'ray', see Install in the README"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "ddpg-mpfa_per-0").exists()


@pytest.mark.usefixtures("in_this_process")
def test_a_run_that_fails_is_named_and_the_others_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A file where the run wants its checkpoint, which is no checkpoint.
    (tmp_path / "ddpg-mpfa_per-0").mkdir()
    (tmp_path / "ddpg-mpfa_per-0" / files.CHECKPOINT).write_bytes(b"no checkpoint")
    assert compare.main(comparison(tmp_path, "--jobs", "1")) == 1
    assert "ddpg-mpfa_per-0: failed, see" in capsys.readouterr().out
    assert set(read_table(tmp_path / files.EPISODES)["method"]) == {"uniform"}


def test_defaults_of_a_comparison_give_way_to_its_command_line() -> None:
    assert with_defaults(["tracking=offline"]) == ["evaluation.every=5000", "tracking=offline"]


def test_an_arm_gives_way_to_nothing_and_keeps_what_is_in_brackets_together() -> None:
    stages = "curriculum.stages=[{world: A, actions: 5},{world: 'B,C', actions: 5}]"
    arm = parse_arm(f"mine:method.signals=[reward,td_error], {stages},learner.gamma=0.9")
    assert arm.settings == ("method.signals=[reward,td_error]", stages, "learner.gamma=0.9")
    assert arm.over(["robots=2", "learner.gamma=0.5"]) == ["robots=2", *arm.settings]
    group = parse_arm("a:curriculum=A")
    assert group.over(["curriculum.carry=false", "robots=2"]) == ["robots=2", "curriculum=A"]
