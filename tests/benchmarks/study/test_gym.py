"""Table F of the study: what is trained, what goes on after a kill, and its page."""

from __future__ import annotations

import ast
import json
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymWrapper, InitTracker, TransformedEnv

from benchmarks.study import pages as study_pages
from benchmarks.study import report
from benchmarks.study.gym import runs, script, table, tasks, training
from benchmarks.study.gym.runs import EVALUATIONS, SETTINGS, Run, wanted
from benchmarks.study.gym.table import ALL, SEEDS, TABLE_F, label_of, missing, read_runs, with_mean
from benchmarks.study.gym.tasks import TASKS, make_env, task_of
from benchmarks.study.gym.training import (
    METHODS,
    Regime,
    Settings,
    greedy_returns,
    iterations,
    train,
)
from benchmarks.study.kept_rows import read_kept
from benchmarks.study.rows import Rows, scores_of
from torchrl_mpfa.methods import Replay, loss_options, make_replay

# Rewards of one sign: mpfa_per weights its signals equally there.
pytestmark = pytest.mark.filterwarnings("ignore:positive_above='mean'")

PENDULUM = TASKS["Pendulum-v1"]
TINY = Regime(actions=96, first_actions=16, batch_size=16, width=8, every=48, episodes=1, updates=1)
BRIEF = replace(TINY, actions=48)


def test_the_runs_know_nothing_of_navigation() -> None:
    for module in (tasks, training, runs):
        assert module.__file__ is not None
        source = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
        froms = {n.module for n in ast.walk(source) if isinstance(n, ast.ImportFrom) and n.module}
        names = {a.name for n in ast.walk(source) if isinstance(n, ast.Import) for a in n.names}
        assert not {name.split(".")[0] for name in froms | names} & {"training", "mpfa_envs"}


def test_a_return_is_brought_between_zero_and_one() -> None:
    assert [PENDULUM.score(value) for value in (-3000.0, -987.0, 0.0)] == [0.0, 0.5, 1.0]
    car = TASKS["MountainCarContinuous-v0"]
    assert [car.score(value) for value in (-99.9, 0.0, 93.0, 100.0)] == [0.0, 0.0, 0.93, 1.0]


@pytest.mark.parametrize("name", list(TASKS))
def test_actions_and_bounded_observations_are_between_minus_one_and_one(name: str) -> None:
    task = TASKS[name]
    if task.needs and find_spec(task.needs) is None:
        pytest.skip(f"{task.needs} is not installed")
    env = make_env(task)
    first, _ = env.reset(seed=0)
    assert first.dtype == np.float32
    assert env.action_space.low.min() == -1.0 and env.action_space.high.max() == 1.0
    if name == "MountainCarContinuous-v0":
        # At rest, between -0.6 and -0.4 of what goes from -1.2 to 0.6.
        assert first[1] == 0.0 and -1 / 3 <= first[0] <= -1 / 9
        seen = [env.step(env.action_space.high)[0][1] for _ in range(3)]
        assert seen[0] > 0.005
    env.close()


def test_an_action_is_held_for_some_steps_and_their_rewards_are_added() -> None:
    task = replace(PENDULUM, repeat=3)
    held, plain = make_env(task), make_env(PENDULUM)
    first, same = held.reset(seed=5)[0], plain.reset(seed=5)[0]
    np.testing.assert_array_equal(first, same)
    for number in range(67):
        action = np.array([np.sin(number)], np.float32)
        seen, reward, _, cut, _ = held.step(action)
        steps = [plain.step(action) for _ in range(3 if number < 66 else 2)]
        np.testing.assert_array_equal(seen, steps[-1][0])
        assert reward == pytest.approx(sum(float(step[1]) for step in steps))
        # Of the last action only two steps are left of 200.
        assert cut == (number == 66) == steps[-1][3]


@pytest.mark.parametrize("method", METHODS)
def test_a_run_has_an_evaluation_each_so_many_actions(method: str) -> None:
    found = train(Settings("Pendulum-v1", method, 3, TINY))
    assert found["actions"].tolist() == [48, 96]
    assert found["return"].between(-2000.0, 0.0).all()
    np.testing.assert_allclose(found["score"], [PENDULUM.score(r) for r in found["return"]])
    assert found["trained_for"].is_monotonic_increasing


def test_the_same_seed_gives_the_same_run_and_another_one_another() -> None:
    first, again, other = (
        train(Settings("Pendulum-v1", "mpfa_per", seed, BRIEF)) for seed in (3, 3, 4)
    )
    assert first["return"].tolist() == again["return"].tolist() != other["return"].tolist()


def rows_of(method: str, regime: Regime = BRIEF, *, used: int = 0) -> tuple[TensorDict, int]:
    """Transitions and updates of a run, before which some random numbers more were used."""
    settings = Settings("Pendulum-v1", method, 3, regime)
    torch.manual_seed(3)
    env = TransformedEnv(GymWrapper(make_env(PENDULUM)), InitTracker())
    env.set_seed(3)
    learner = training.make_learner(settings, env)
    replay = make_replay(method, capacity=1000, batch_size=16)
    torch.rand(used)
    for _ in iterations(settings.regime, env, learner, replay, seed=3):
        pass
    return replay.buffer[:], learner.updates


def test_all_methods_begin_with_the_same_networks_starts_and_noise() -> None:
    (ours, updates), (theirs, _) = rows_of("mpfa_per"), rows_of("uniform", used=7)
    first = TINY.first_actions
    for key in ("observation", "action", ("next", "reward")):
        torch.testing.assert_close(ours[key][:first], theirs[key][:first])
    # From the sixteenth action on one for each four.
    assert updates == (48 - 16) // 4 + 1


def test_the_replay_is_made_for_the_task_and_its_exponent_reaches_its_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[tuple[dict[str, Any], Replay]] = []
    real = training.make_replay

    def make(method: str, **named: Any) -> Replay:
        made.append((named, real(method, **named)))
        return made[0][1]

    monkeypatch.setattr(training, "make_replay", make)
    train(Settings("Pendulum-v1", "mpfa_per", 3, BRIEF))
    ((named, replay),) = made
    assert (named["positive_above"], named["capacity"]) == ("mean", 48)
    assert named["generator"].initial_seed() == 3
    assert replay.method.beta < replay.method.beta_end
    assert replay.buffer.sampler.beta == pytest.approx(replay.method.beta_end)


@pytest.mark.parametrize("method", METHODS)
def test_the_loss_writes_the_signals_of_the_method(method: str) -> None:
    learner = training.make_learner(
        Settings("Pendulum-v1", method, 3, TINY), GymWrapper(make_env(PENDULUM))
    )
    assert list(learner.loss.signals) == loss_options(method)["signals"]


def test_the_time_of_evaluations_is_none_of_the_training(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0

    def evaluated(*_: Any) -> np.ndarray:
        nonlocal now
        now += 100.0
        return np.zeros(1)

    def blocks(*parts: Any, **named: Any) -> Iterator[int]:
        nonlocal now
        for actions in iterations(*parts, **named):
            now += 1.0
            yield actions

    monkeypatch.setattr(training, "time", SimpleNamespace(perf_counter=lambda: now))
    monkeypatch.setattr(training, "greedy_returns", evaluated)
    monkeypatch.setattr(training, "iterations", blocks)
    found = train(Settings("Pendulum-v1", "uniform", 3, TINY))
    # Four actions in each block.
    assert found["trained_for"].tolist() == [12.0, 24.0]


def test_noise_goes_on_from_one_block_of_actions_to_the_next() -> None:
    # Untrained actors choose about zero: what is left is noise, which loses 0.15 in a step.
    rows, _ = rows_of("uniform", replace(TINY, actions=600, first_actions=600))
    noise = rows["action"][:, 0].numpy()
    whole = np.corrcoef(noise[:-1], noise[1:])[0, 1]
    across = np.corrcoef(noise[3:-1:4], noise[4::4])[0, 1]
    assert whole == pytest.approx(0.85, abs=0.1)
    assert across == pytest.approx(whole, abs=0.1)
    assert np.abs(noise[-100:]).mean() < 0.5 * np.abs(noise[:100]).mean()


def test_an_evaluation_adds_the_rewards_of_each_episode_up_to_its_end() -> None:
    def still(batch: TensorDict) -> TensorDict:
        return batch.set("action", torch.zeros(len(batch), 1))

    found = greedy_returns(still, PENDULUM, 3)  # type: ignore[arg-type]
    for number, value in enumerate(found):
        env = make_env(PENDULUM)
        env.reset(seed=10_000 + number)
        steps = [env.step(np.zeros(1, np.float32)) for _ in range(200)]
        assert value == pytest.approx(sum(float(step[1]) for step in steps), rel=1e-6)
        assert steps[-1][3] and not steps[-2][3]


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs in a thread of this process, which take no second."""
    monkeypatch.setattr(script, "workers", ThreadPoolExecutor)
    real = script.wanted
    monkeypatch.setattr(
        script,
        "wanted",
        lambda *words, **_: [
            replace(run, settings=replace(run.settings, regime=TINY)) for run in real(*words)
        ],
    )


def asked(folder: Path, *more: str) -> list[str]:
    words = ["--folder", str(folder), "--tasks", "Pendulum-v1", "--seeds", "100", "--jobs", "1"]
    return [*words, "--methods", "uniform", "per", *more]


@pytest.mark.usefixtures("here")
def test_what_is_done_is_left_alone_and_what_was_interrupted_is_made_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script.main(asked(tmp_path)) == 0
    assert "2 runs, 0 of them done" in capsys.readouterr().out
    done, cut = (tmp_path / f"Pendulum-v1-{method}-100" for method in ("uniform", "per"))
    assert pd.read_csv(done / EVALUATIONS)["actions"].tolist() == [48, 96]
    assert json.loads((cut / SETTINGS).read_text())["regime"]["width"] == 8
    before = (done / EVALUATIONS).stat().st_mtime_ns, (cut / EVALUATIONS).read_bytes()
    # As a kill leaves it: the evaluations come last.
    (cut / EVALUATIONS).unlink()
    assert script.main(asked(tmp_path)) == 0
    assert "2 runs, 1 of them done" in capsys.readouterr().out
    assert (done / EVALUATIONS).stat().st_mtime_ns == before[0]
    again = pd.read_csv(cut / EVALUATIONS)
    (tmp_path / "before.csv").write_bytes(before[1])
    assert again["return"].tolist() == pd.read_csv(tmp_path / "before.csv")["return"].tolist()
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.usefixtures("here")
def test_a_run_of_other_settings_is_not_taken_for_one_of_these(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "Pendulum-v1-per-100"
    run.mkdir()
    (run / EVALUATIONS).write_text("actions,return,score,trained_for\n")
    other = Settings("Pendulum-v1", "per", 100, replace(TINY, width=9))
    (run / SETTINGS).write_text(json.dumps(asdict(other)))
    assert script.main(asked(tmp_path)) == 2
    assert "was made with width=9, asked for is 8" in (found := capsys.readouterr().err)
    assert found.count("\n") == 1
    assert not (tmp_path / "Pendulum-v1-uniform-100").exists()


@pytest.mark.usefixtures("here")
def test_a_run_that_fails_does_not_keep_the_others_from_theirs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def make(run: Run) -> None:
        if run.settings.method == "uniform":
            raise ValueError("no luck")
        runs.make(run)

    monkeypatch.setattr(script, "make", make)
    assert script.main(asked(tmp_path)) == 1
    assert "Pendulum-v1-uniform-100: failed, ValueError: no luck" in capsys.readouterr().out
    assert (tmp_path / "Pendulum-v1-per-100" / EVALUATIONS).exists()


@pytest.mark.usefixtures("here")
def test_a_signal_lets_the_run_that_is_under_way_end_and_begins_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = []
    stops = []
    real = script.Stop

    def stop(answer: str) -> script.Stop:
        stops.append(real(answer))
        return stops[0]

    def make(run: Run) -> None:
        begun.append(run.name)
        stops[0].ask(signal.SIGINT)

    monkeypatch.setattr(script, "Stop", stop)
    monkeypatch.setattr(script, "make", make)
    assert script.main(asked(tmp_path)) == 130
    assert begun == ["Pendulum-v1-uniform-100"]


def test_a_task_whose_engine_is_missing_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tasks, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"needs mujoco: pip install 'torchrl-mpfa\[mujoco\]'"):
        task_of("Reacher-v5")


def test_a_regime_that_never_learns_raises() -> None:
    with pytest.raises(ValueError, match="first_actions must be at least batch_size, 256, got 8"):
        Regime(first_actions=8)


def made_up(folder: Path) -> Path:
    """Runs of every arm; PER is better by as much in each seed."""
    for run in wanted(list(TASKS), METHODS, SEEDS, folder):
        place = 0.01 * (run.settings.seed - SEEDS[0]) + 0.1 * list(TASKS).index(run.settings.task)
        score = 0.3 + place + 0.2 * (run.settings.method == "per")
        run.path.mkdir(parents=True)
        found = pd.DataFrame({"actions": [6000, 12_000], "score": score, "return": -1.5})
        found.to_csv(run.evaluations, index=False)
    return folder


def test_table_f_has_the_runs_and_comparisons_that_were_planned() -> None:
    assert len(wanted(list(TASKS), METHODS, SEEDS, Path("x"))) == 120
    assert TABLE_F.planned == tuple(
        (f"gym/all tasks/{method}", "gym/all tasks/uniform") for method in METHODS[1:]
    )
    shown = {label for panel in TABLE_F.panels.values() for label in panel}
    assert len(shown) == 4 * len(METHODS)
    assert {label for pair in (*TABLE_F.planned, *TABLE_F.explored) for label in pair} == shown
    assert len(set(TABLE_F.explored)) == 3 + 3 * 6


def test_the_mean_of_the_tasks_is_of_the_seeds_that_all_of_them_have(tmp_path: Path) -> None:
    folder = made_up(tmp_path)
    (folder / f"{PENDULUM.name}-per-103" / EVALUATIONS).unlink()
    rows = read_runs(folder)
    scores = scores_of(with_mean(rows), TABLE_F)
    per, uniform = (scores[label_of(ALL, method)]["area"] for method in ("per", "uniform"))
    assert sorted(per.index) == [s for s in SEEDS if s != 103]
    assert sorted(uniform.index) == list(SEEDS)
    # Curves begin at zero: a quarter of the height is lost.
    assert per[100] == pytest.approx(0.75 * (0.3 + 0.1 + 0.2))
    assert uniform[109] == pytest.approx(0.75 * (0.3 + 0.1 + 0.09))
    assert missing(rows, folder).startswith("Missing: Pendulum-v1-per-103.\n")


def test_page_and_figures_are_made_of_runs_and_of_kept_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # All comparisons and panels take seconds.
    less = {ALL: TABLE_F.panels[ALL]}
    small = replace(TABLE_F, explored=TABLE_F.explored[-3:], panels=less)
    monkeypatch.setattr(study_pages, "TABLE_F", small)
    study, kept, pages = tmp_path / "study", tmp_path / "kept", tmp_path / "pages"
    folder = made_up(study / table.FOLDER)
    assert report.main([str(study), "--output", str(pages)]) == 0
    text = (pages / "F.md").read_text(encoding="utf-8")
    assert "| per − uniform | 10 | +0.150 |" in text
    assert "| mpfa_plus − per | 10 | -0.150 |" in text
    assert "corrected for 3" in text
    assert "curve of score, from zero on" in text
    assert "last policy" not in text and "Missing" not in text
    for name in ("curves", "profiles", "arms"):
        assert (pages / f"F_{name}.png").stat().st_size > 10_000
    script.main(["--folder", str(folder), "--keep", str(kept), "--tasks", "Pendulum-v1"])
    assert "written" in capsys.readouterr().out
    rows = read_kept(kept, "F")
    curves = read_runs(folder).curves.sort_values(["arm", "seed"], kind="stable", ignore_index=True)
    pd.testing.assert_frame_equal(rows.curves, curves)
    assert isinstance(rows, Rows) and rows.curves["return"].eq(-1.5).all()


@pytest.mark.slow
def test_pendulum_is_learned() -> None:
    regime = Regime(actions=8_000, every=8_000, episodes=10)
    training.prepare_process()
    try:
        found = train(Settings("Pendulum-v1", "mpfa_plus", 1000, regime))
    finally:
        torch.set_flush_denormal(False)
    # Untrained actors have about -1,200.
    assert found["return"].iloc[-1] > -300.0
