"""TD3 on a task of Gymnasium: the rows that it learns from, its scores, and that it learns."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

import gymnasium_td3
from gymnasium_td3 import SCORES, Task, collect
from torchrl_mpfa.methods import METHODS


def rounds_of(number: int) -> tuple[Task, TensorDictBase]:
    """Pendulum, and the rows of so many rounds at random, joined."""
    task, source = Task("Pendulum-v1", seed=0), np.random.default_rng(0)
    rows = torch.cat([collect(task, None, source) for _ in range(number)])
    return task, rows


def scores_in(folder: Path) -> list[dict[str, str]]:
    """The rows of a run's scores."""
    with (folder / SCORES).open() as file:
        return list(csv.DictReader(file))


def test_rows_follow_each_other_but_for_a_new_episode() -> None:
    _, rows = rounds_of(41)  # Pendulum's episodes have 200 steps.
    done = rows["next", "done"].squeeze(-1)
    assert done.nonzero().squeeze(-1).tolist() == [199, 399]
    same = (rows["observation"][1:] == rows["next", "observation"][:-1]).all(-1)
    assert torch.equal(same, ~done[:-1])


def test_time_limit_ends_an_episode_without_terminating_it() -> None:
    _, rows = rounds_of(20)
    assert rows["next", "done"][-1]
    assert not rows["next", "terminated"].any()


def test_action_reaches_the_whole_range_of_the_task() -> None:
    task, _ = rounds_of(1)
    assert task.actions == 1
    state = task.env.unwrapped.state.copy()  # type: ignore[attr-defined]
    task.env.step(np.ones(1, np.float32))
    turned = task.env.unwrapped.state[1] - state[1]  # type: ignore[attr-defined]
    # 3 g / 2 l sin(angle) + 3 u / m l^2 in 0.05 s, with the highest torque of 2.
    assert turned == pytest.approx((15.0 * np.sin(state[0]) + 3.0 * 2.0) * 0.05, abs=1e-6)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--start", "99"], "--start must be at least one batch of 100, got 99"),
        (["--every", "300", "--steps", "200"], "--every must be in 10 to 200, got 300"),
        (["--replay", "her"], "invalid choice: 'her'"),
        (["--replay", "per", "--positive-above", "1"], "--positive-above: "),
        (["--folder", "/dev/null"], "/dev/null"),
    ],
)
def test_what_the_page_cannot_do_is_rejected_before_it_trains(
    words: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(gymnasium_td3, "train", lambda options: pytest.fail("trained"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        gymnasium_td3.main(words)
    assert message in capsys.readouterr().err


@pytest.mark.usefixtures("reconstructed")
def test_methods_that_ask_for_more_than_a_buffer_and_a_loss_are_named_by_what_they_ask() -> None:
    beside = {name: method.beside for name, method in METHODS.items() if method.beside}
    assert beside == {
        "averaged_ddpg": ("learner",),
        "ddpg_radam": ("bonus", "learner"),
        "her": ("hindsight", "episode"),
        "klper": ("policy", "sigma"),
        "reaper": ("episode",),
        "ref_er": ("policy", "behavior_mean", "behavior_sigma"),
        "rud": ("update_block",),
    }


@pytest.mark.filterwarnings("ignore:none of the .* rewards in the buffer are above")
def test_run_with_scores_is_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    short = ["--task", "Pendulum-v1", "--steps", "200", "--start", "150", "--every", "200"]
    # A program of the updates takes half a minute to compile.
    command = [*short, "--eager", "--folder", str(tmp_path)]
    monkeypatch.setattr(gymnasium_td3, "EPISODES", 2)
    folder = gymnasium_td3.main(command)
    rows = scores_in(folder)
    assert [row["steps"] for row in rows] == ["200"]
    assert {row["method"] for row in rows} == {"td3/mpfa_per"}
    monkeypatch.setattr(gymnasium_td3, "train", lambda options: pytest.fail("made again"))
    assert gymnasium_td3.main(command) == folder
    with pytest.raises(SystemExit):
        gymnasium_td3.main([*command, "--every", "100"])


@pytest.mark.slow
@pytest.mark.parametrize("replay", ["uniform", "mpfa_per"])
def test_pendulum_swings_up(replay: str, tmp_path: Path) -> None:
    short = ["--task", "Pendulum-v1", "--steps", "6000", "--start", "1000", "--every", "6000"]
    short += ["--positive-above", "-2"] if replay == "mpfa_per" else []
    folder = gymnasium_td3.main([*short, "--replay", replay, "--folder", str(tmp_path)])
    [row] = scores_in(folder)
    # At random some -1,200; a policy that swings up reaches -150.
    assert float(row["score"]) > -600
