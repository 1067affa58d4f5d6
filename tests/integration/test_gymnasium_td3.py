"""TD3 on a task of Gymnasium: the rows that it learns from, its scores, and that it learns."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

import gymnasium_td3
import torchrl_mpfa as mpfa
from gymnasium_td3 import SCORES, STATISTICS, Scale, Task, collect, score
from torchrl_mpfa.methods import METHODS
from torchrl_mpfa.methods.her import GymnasiumGoals
from torchrl_mpfa.selection import SampledBatch

PENDULUM = "Pendulum-v1"
POINT, MAZE = "tests/Point-v0", "tests/PointLikeMazes-v0"


class Point(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """A point in a square that is paid where it is near its goal, for ten steps."""

    at_goal = "is_success"
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (2,), np.float32)
    observation_space = gymnasium.spaces.Dict(
        {
            "observation": gymnasium.spaces.Box(-9.0, 9.0, (3,)),
            "achieved_goal": gymnasium.spaces.Box(-9.0, 9.0, (2,)),
            "desired_goal": gymnasium.spaces.Box(-9.0, 9.0, (2,)),
        }
    )

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place, self.steps = np.zeros(2, np.float32), 0
        self.goal = self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)
        return self.seen(), {}

    def seen(self) -> dict[str, np.ndarray]:
        return {
            "observation": np.array([*self.place, self.steps], np.float32),
            "achieved_goal": self.place.copy(),
            "desired_goal": self.goal.copy(),
        }

    def step(self, action: np.ndarray) -> Any:
        self.place = np.clip(self.place + 0.1 * action, -1.0, 1.0).astype(np.float32)
        self.steps += 1
        reward = self.compute_reward(self.place, self.goal, {})
        info = {self.at_goal: reward == 0.0}
        return self.seen(), float(reward), False, self.steps == 10, info

    def compute_reward(self, achieved: np.ndarray, wanted: np.ndarray, info: Any) -> np.ndarray:
        return -(np.linalg.norm(achieved - wanted, axis=-1) > 0.3).astype(np.float64)


class PointLikeMazes(Point):
    """The same, but that it is at its goal has the name that mazes give it."""

    at_goal = "success"


for name, task in ((POINT, Point), (MAZE, PointLikeMazes)):
    if name not in gymnasium.registry:
        gymnasium.register(name, task)


def rounds_of(number: int) -> tuple[Task, TensorDictBase]:
    """Pendulum, and the rows of so many rounds at random, joined."""
    task, source = Task("Pendulum-v1", seed=0), np.random.default_rng(0)
    rows = torch.cat([collect(task, None, source) for _ in range(number)])
    return task, rows


def scores_in(folder: Path, name: str = SCORES) -> list[dict[str, str]]:
    """The rows of a run's scores, or of what its replay says of itself."""
    with (folder / name).open() as file:
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
        (
            ["--task", POINT, "--replay", "per", "--goals-for", "transition"],
            "--goals-for must be episode without goals in hindsight, got transition",
        ),
        (["--updates", "0"], "--updates must be at least 1, got 0"),
        (["--replay", "rud"], "invalid choice: 'rud'"),
        (["--task", PENDULUM, "--replay", "her"], f"without hindsight, as {PENDULUM} has no goals"),
        (["--task", PENDULUM, "--hindsight", "2"], f"without hindsight, as {PENDULUM} has no"),
        (["--task", "CartPole-v1"], "must have vectors to see and to do, got CartPole-v1"),
        (["--task", "Pendulums-v1"], "Environment `Pendulums` doesn't exist"),
        (["--seed", "-1"], "--seed must be in 0 to 2**32 - 1, got -1"),
        (["--steps", "300", "--start", "500", "--every", "200"], "--steps must be more than"),
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
    monkeypatch.setattr(gymnasium_td3, "train", lambda *_: pytest.fail("trained"))
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
    [said] = scores_in(folder, STATISTICS)
    assert (said["steps"], said["size"]) == ("200", "200")
    shares = [float(value) for name, value in said.items() if name.startswith("share/")]
    assert len(shares) == 3 and sum(shares) == pytest.approx(1.0)
    monkeypatch.setattr(gymnasium_td3, "train", lambda *_: pytest.fail("made again"))
    assert gymnasium_td3.main(command) == folder
    with pytest.raises(SystemExit):
        gymnasium_td3.main([*command, "--every", "100"])


def test_rows_of_a_goal_task_end_with_the_goal_and_its_rewards_are_those_of_the_task() -> None:
    task = Task(POINT, seed=0)
    rows = torch.cat([collect(task, None, np.random.default_rng(0)) for _ in range(2)])
    assert task.has_goal and (task.observations, task.actions) == (5, 2)
    assert rows["observation"].shape == (20, 5)
    assert rows["episode"].flatten().tolist() == [0] * 10 + [1] * 10
    assert (rows["observation"][:10, 3:] == rows["observation"][0, 3:]).all()
    assert not torch.equal(rows["observation"][10, 3:], rows["observation"][0, 3:])
    # The last observation of an episode is its own, and not the first of the next.
    assert rows["next", "observation"][9, 2] == 10 and rows["observation"][10, 2] == 0
    relabel = GymnasiumGoals(task.compute_reward)
    again = relabel(rows[:10], torch.tensor([4, 9]))
    assert len(again) == 5 + 10 and "achieved_goal" not in again["next"]
    achieved = rows["next", "achieved_goal"]
    for number, (step, first) in enumerate([(4, 0), (9, 5)]):
        part = again[first : first + step + 1]
        assert (part["observation"][:, 3:] == achieved[step]).all(), number
        assert (part["next", "observation"][:, 3:] == achieved[step]).all()
        assert torch.equal(part["observation"][:, :3], rows["observation"][: step + 1, :3])
        far = (achieved[: step + 1] - achieved[step]).norm(dim=-1) > 0.3
        assert torch.equal(part["next", "reward"].flatten(), -far.float())
        assert part["next", "reward"][-1] == 0.0
    # What was stored is not changed.
    assert (rows["observation"][:10, 3:] == rows["observation"][0, 3:]).all()


def test_goals_for_each_transition_are_reached_after_it_and_all_of_them_are_as_likely() -> None:
    task = Task(POINT, seed=0)
    [rows] = [collect(task, None, np.random.default_rng(0))]
    seeded = {"generator": torch.Generator().manual_seed(0)}
    relabel = GymnasiumGoals(task.compute_reward, goals_for="transition", **seeded)
    again = [relabel(rows, torch.tensor([0, 1, 2, 3])) for _ in range(300)]
    achieved = rows["next", "achieved_goal"]
    counts = torch.zeros(10, 10)
    for part in again:
        assert len(part) == 40
        assert torch.equal(
            part["observation"][:, :3], rows["observation"].repeat_interleave(4, 0)[:, :3]
        )
        goals = part["observation"][:, 3:]
        assert torch.equal(part["next", "observation"][:, 3:], goals)
        place = (goals[:, None] == achieved).all(-1).float().argmax(-1)
        far = (achieved.repeat_interleave(4, 0) - goals).norm(dim=-1) > 0.3
        assert torch.equal(part["next", "reward"].flatten(), -far.float())
        counts.index_put_((torch.arange(10).repeat_interleave(4), place), torch.ones(40), True)
    shares = counts / counts.sum(1, keepdim=True)
    for step in range(10):
        assert not counts[step, :step].any()
        assert (shares[step, step:] - 1 / (10 - step)).abs().max() < 0.06
    with pytest.raises(ValueError, match="goals_for must be one of episode, transition, got 'row'"):
        GymnasiumGoals(task.compute_reward, goals_for="row")


class Towards:
    """Drives to the goal, and away from it in the last steps if it is to leave."""

    def __init__(self, leaves: bool) -> None:
        self.leaves = leaves

    def __call__(self, seen: Tensor) -> np.ndarray:
        if self.leaves and seen[2] >= 5:
            return -np.sign(seen[3:].numpy())
        return np.clip(5.0 * (seen[3:] - seen[:2]).numpy(), -1.0, 1.0)


@pytest.mark.parametrize("task", [POINT, MAZE])
def test_the_score_of_a_goal_task_is_the_share_of_episodes_that_end_at_the_goal(
    task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gymnasium_td3, "EPISODES", 4)
    assert score(task, Towards(leaves=False), seed=0) == 1.0
    assert score(task, Towards(leaves=True), seed=0) == 0.0


def test_the_score_of_another_task_is_the_mean_return(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gymnasium_td3, "EPISODES", 2)
    still = lambda seen: np.zeros(1, np.float32)  # noqa: E731
    task, returns = Task(PENDULUM, seed=5), []
    for _ in range(2):
        steps = [task.step(torch.from_numpy(task.state), still(None)) for _ in range(200)]
        returns.append(sum(step["next", "reward"].item() for step in steps))
    assert score(PENDULUM, still, seed=5) == pytest.approx(sum(returns) / 2)


def test_actions_have_noise_of_the_spread_that_was_asked_for() -> None:
    task, still = Task(POINT, seed=0), lambda seen: np.zeros(2, np.float32)
    source = np.random.default_rng(0)
    rows = [collect(task, still, source, noise=0.3)["action"] for _ in range(40)]
    assert torch.cat(rows).std() == pytest.approx(0.3, rel=0.1)


def test_an_episode_that_was_terminated_gets_no_other_goal() -> None:
    rows = collect(Task(POINT, seed=0), None, np.random.default_rng(0))
    rows["next", "terminated"][-1] = True
    with pytest.raises(ValueError, match="terminated of a goal task must be False at all steps"):
        GymnasiumGoals(Point().compute_reward)(rows, torch.tensor([3]))


def test_observations_of_goal_tasks_are_normalized_by_all_that_was_seen() -> None:
    scale, seen = Scale(3, moves=True), torch.randn(40, 3) * torch.tensor([1.0, 20.0, 0.0]) + 7.0
    for part in seen.split(8):
        scale.see(part)
    found = scale(seen)
    assert found[:, :2].mean(0).abs().max() < 1e-5
    assert (found[:, :2].std(0, correction=0) - 1.0).abs().max() < 1e-4
    assert found[:, 2].abs().max() < 1e-3
    assert scale(torch.full((3,), 1e6)).tolist() == [5.0, 5.0, 5.0]
    assert torch.equal(Scale(3, moves=False)(seen), seen)


def test_observations_that_never_change_are_normalized_to_zero() -> None:
    scale, seen = Scale(3, moves=True), torch.tensor([0.1, 1.7, 123.456])
    for _ in range(100):
        scale.see(seen.expand(10, 3))
    assert (scale.squares < 0.0).any()
    assert scale(seen).abs().max() < 1e-2


def test_hindsight_adds_rows_and_another_method_takes_it_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    kept = gymnasium_td3.make_replay
    monkeypatch.setattr(
        gymnasium_td3,
        "make_replay",
        lambda *words, **given: made.append(kept(*words, **given)) or made[-1],
    )
    prepared: set[Any] = set()
    run = mpfa.run_updates
    monkeypatch.setattr(
        mpfa,
        "run_updates",
        lambda *words, prepare, **given: (
            prepared.clear(),
            prepared.add(prepare),
            run(*words, prepare=prepare, **given),
        )[2],
    )
    monkeypatch.setattr(gymnasium_td3, "EPISODES", 2)
    short = ["--task", POINT, "--steps", "60", "--start", "40", "--every", "60", "--eager"]
    short += ["--batch-size", "16", "--width", "8", "--folder", str(tmp_path)]
    for words in (["uniform"], ["her"], ["per", "--hindsight", "2"]):
        gymnasium_td3.main([*short, "--replay", *words])
    uniform, her, per = (len(replay.buffer) for replay in made)
    assert uniform == 60 < per < her <= 60 * 5
    goals = [replay.buffer[:]["observation"][:, 3:].unique(dim=0) for replay in made]
    # Six episodes have a goal each, and as many more as were asked for.
    assert [len(of_run) for of_run in goals] == [6, 6 * 5, 6 * 3]
    assert made[2].buffer.sampler.beta == 1.0
    [prepare] = prepared
    sampled = prepare(SampledBatch(made[2].buffer.sample()))
    assert prepare.__self__.count == 60
    for rows in (sampled.batch, sampled.batch["next"]):
        assert rows["observation"].abs().max() <= 5.0
    raw = made[2].buffer[:]["next", "observation"]
    assert raw[:, 2].max() == 10.0
    for replay in made:
        assert set(replay.buffer[:].keys()) >= {"observation", "action", "next"}
        assert "achieved_goal" not in replay.buffer[:]["next"].keys()  # noqa: SIM118
    names = {row["method"] for folder in tmp_path.iterdir() for row in scores_in(folder)}
    assert names == {"td3/uniform", "td3/her", "td3/per-hindsight2"}


def test_each_step_has_as_many_updates_as_were_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    run = mpfa.run_updates
    monkeypatch.setattr(
        mpfa,
        "run_updates",
        lambda *words, updates, **given: (
            made.append(updates),
            run(*words, updates=updates, **given),
        )[1],
    )
    monkeypatch.setattr(gymnasium_td3, "EPISODES", 1)
    short = ["--task", POINT, "--steps", "40", "--start", "20", "--every", "40", "--eager"]
    short += ["--batch-size", "16", "--width", "8", "--folder", str(tmp_path), "--replay", "her"]
    folders = [gymnasium_td3.main(short), gymnasium_td3.main([*short, "--updates", "3"])]
    # Two rounds of ten steps learn.
    assert made == [10, 10, 30, 30]
    assert folders[1].name == f"{folders[0].name.removesuffix('-0')}-updates3-0"


def test_options_reach_what_they_are_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rounds: list[tuple[Any, float]] = []
    tests: list[tuple[Any, int]] = []
    betas: list[float] = []
    made: list[Any] = []

    def collects(task: Task, acts: Any, source: Any, *, noise: float) -> TensorDictBase:
        rounds.append((acts, noise))
        return collect(task, acts, source, noise=noise)

    def tested(name: str, acts: Any, *, seed: int) -> float:
        tests.append((acts, seed))
        return 0.5

    def updated(buffer: Any, learner: Any, *words: Any, **given: Any) -> Any:
        betas.append(buffer.sampler.beta)
        return run(buffer, learner, *words, **given)

    run, learns = mpfa.run_updates, mpfa.ActorCritic
    monkeypatch.setattr(gymnasium_td3, "collect", collects)
    monkeypatch.setattr(gymnasium_td3, "score", tested)
    monkeypatch.setattr(mpfa, "run_updates", updated)
    monkeypatch.setattr(
        mpfa,
        "ActorCritic",
        lambda *networks, **given: made.append(given) or learns(*networks, **given),
    )
    words = ["--steps", "60", "--start", "30", "--every", "60", "--batch-size", "16", "--eager"]
    words += ["--gamma", "0.9", "--tau", "0.2", "--noise", "0.4", "--width", "8", "--seed", "3"]
    gymnasium_td3.main(
        ["--task", POINT, "--replay", "per", *words, "--folder", str(tmp_path), "--hindsight", "2"]
    )
    # The first steps are at random, all others by the policy with noise.
    assert [acts is None for acts, _ in rounds] == [True] * 3 + [False] * 3
    assert {noise for _, noise in rounds} == {0.4}
    [given] = made
    asked = {"gamma": 0.9, "tau": 0.2, "policy_delay": 2, "policy_noise": 0.2, "noise_clip": 0.5}
    assert {name: given[name] for name in asked} == asked
    # Tests have starts of their own, the same for all seeds.
    [(acts, seed)] = tests
    assert seed == 1_000_000 and acts is rounds[-1][0]
    seen = torch.randn(5)
    assert (acts(seen) == acts.actor.act(acts.scale(seen)).numpy()).all()
    assert not torch.equal(acts.scale(seen), seen)
    assert betas == sorted(betas) and betas[0] < betas[-1] == 1.0


@pytest.mark.slow
def test_hindsight_learns_a_goal_task_that_uniform_replay_does_not(tmp_path: Path) -> None:
    short = ["--task", POINT, "--steps", "3000", "--start", "500", "--every", "3000", "--eager"]
    short += ["--gamma", "0.9", "--folder", str(tmp_path), "--width", "64"]
    folder = gymnasium_td3.main([*short, "--replay", "her"])
    [row] = scores_in(folder)
    # At random a tenth of the episodes end near their goal.
    assert float(row["score"]) >= 0.8


@pytest.mark.slow
@pytest.mark.parametrize("replay", ["uniform", "mpfa_per"])
def test_pendulum_swings_up(replay: str, tmp_path: Path) -> None:
    short = ["--task", "Pendulum-v1", "--steps", "6000", "--start", "1000", "--every", "6000"]
    short += ["--positive-above", "-2"] if replay == "mpfa_per" else []
    folder = gymnasium_td3.main([*short, "--replay", replay, "--folder", str(tmp_path)])
    [row] = scores_in(folder)
    # At random some -1,200; a policy that swings up reaches -150.
    assert float(row["score"]) > -600
