"""TD7's rule: policies that are held fixed, assessed by whole episodes, and kept by the worst."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mpfa_envs import load_policy
from tests.integration.tiny_runs import Look, assert_same_run, go_on, tiny, train, weights_of
from training.records import read_table
from training.run import loop
from training.run.assessment import Assessment, AssessmentSettings
from training.run.checkpoints import read_checkpoint
from training.run.loop import TrainingRun
from training.settings.train import Stage, TrainSettings


def assessed(
    by: str = "outcome",
    *,
    robots: int = 3,
    stages: list[Stage] | None = None,
    learner: str = "ddpg",
) -> TrainSettings:
    stages = stages or [Stage("A", actions=360 if robots > 1 else 200)]
    settings = tiny(episodes=stages, learner=learner, robots=robots, updates=1)
    settings.environment.max_steps, settings.environment.clearance = 12, 0.4
    settings.exploration.random_steps = 60
    settings.assessment = AssessmentSettings(
        episodes=5, early_episodes=2, early_share=0.4, best_factor=0.0, by=by
    )
    return settings


class Watched:
    """A run, with what it did in each iteration."""

    def __init__(self, folder: Path, settings: TrainSettings) -> None:
        folder.mkdir(exist_ok=True)
        run = self.run = TrainingRun(settings, folder, hooks=[Look(self._note)])
        self.rows: list[Any] = []
        self.weights, self.updates = [weights_of(run.learner.policy)], [0]
        extend = run.buffer.extend

        def extended(rows: Any) -> torch.Tensor:
            self.rows.append(rows.clone())
            return extend(rows)

        run.buffer.extend = extended  # type: ignore[method-assign]
        run.train()
        run.close()

    def _note(self, run: TrainingRun) -> None:
        self.weights.append(weights_of(run.learner.policy))
        self.updates.append(run.updates)


def oracle(watched: Watched) -> tuple[list[int], list[tuple[int, bool, float]]]:
    """Updates after each iteration, and of each assessment its begin, its verdict, its least."""
    settings = watched.run.settings
    rule, robots = settings.assessment, settings.robots
    updates, waiting, found = [0], 0, []
    begun = {robot: 0 for robot in range(robots)}
    starts = [(0, robot) for robot in range(robots)]
    returns = [0.0] * robots
    held: int | None = None
    best, late, scores = -math.inf, False, list[float]()
    for now, rows in enumerate(watched.rows):
        over = held is None
        for robot in range(robots):
            returns[robot] += float(rows["next", "reward"][robot])
            if not rows["next", "done"][robot]:
                continue
            # Of the last action's two time steps the first may have paid for progress.
            pays = 10.0 if rows["next", "reward"][robot] > 5.0 else -5.0
            outcome = pays if rows["next", "terminated"][robot] else 0.0
            score = returns[robot] if rule.by == "return" else outcome
            mine = (begun[robot], robot)
            returns[robot], begun[robot] = 0.0, now + 1
            starts.append((now + 1, robot))
            if held is None or over or mine[0] < held:
                continue
            wanted = rule.episodes if late else rule.early_episodes
            if mine in sorted(each for each in starts if each[0] >= held)[:wanted]:
                scores.append(score)
                if score < best or len(scores) == wanted:
                    over = True
        if over and held is not None:
            found.append((held, min(scores) >= best, min(scores)))
            best = max(best, min(scores))
        actions = (now + 1) * robots
        if min(actions, settings.method.capacity) >= settings.method.batch_size:
            waiting += 1
            if over:
                updates.append(updates[-1] + waiting)
                waiting = 0
            else:
                updates.append(updates[-1])
        else:
            updates.append(updates[-1])
        if over and actions >= settings.exploration.random_steps:
            if not late and actions >= rule.early_share * settings.curriculum.stages[0].actions:
                late = True
                best -= (1 - rule.best_factor) * abs(best) if best > -math.inf else 0.0
            held, scores = now + 1, []
    return updates, found


@pytest.mark.parametrize(
    ("by", "robots", "learner"),
    [("return", 3, "ddpg"), ("outcome", 3, "td3"), ("return", 1, "ddpg"), ("return", 4, "dqn")],
)
def test_policies_are_held_assessed_and_kept_as_in_a_plain_loop(
    tmp_path: Path, by: str, robots: int, learner: str
) -> None:
    watched = Watched(tmp_path, assessed(by, robots=robots, learner=learner))
    run = watched.run
    updates, found = oracle(watched)
    assert watched.updates == updates
    assert [(each.kept, each.least) for each in run.assessments] == [
        (kept, pytest.approx(least)) for _, kept, least in found
    ]
    # Both verdicts came up, and an assessment that ended before its time.
    assert {kept for _, kept, _ in found} == {True, False}
    assert len({each.episodes for each in run.assessments}) > 2
    assert max(each.episodes for each in run.assessments) > 2
    held = [begin for begin, kept, _ in found if kept][-1]
    assert run.assessment is not None
    assert run.assessment.kept is not None
    assert weights_of(run.assessment.kept).equal(watched.weights[held])
    for before, after, made, more in zip(
        watched.weights, watched.weights[1:], updates, updates[1:], strict=False
    ):
        if made == more:
            assert before.equal(after)


def td7(returns: list[float], switch: int) -> list[int]:
    """Episodes after which TD7 writes a checkpoint, of one robot; ``switch`` episodes are early."""
    written, best, least, count, most = [], -1e8, 1e8, 0, 1
    for number, score in enumerate(returns):
        count, least = count + 1, min(least, score)
        if least >= best and count < most:
            continue
        if least >= best:
            written.append(number)
            best = least
        if most == 1 and number + 1 >= switch:
            best, most = 0.9 * best, 20
        least, count = 1e8, 0
    return written


def test_one_robot_is_assessed_as_in_td7() -> None:
    sampled = random.Random(0)
    # They improve, or no policy would be kept by the worst of twenty.
    returns = [sampled.uniform(0.1 * number, 10 + 0.2 * number) for number in range(600)]
    rule = Assessment(AssessmentSettings(episodes=20))
    rule.begin(0, late=False, at=(0, 0))
    written = []
    for number, score in enumerate(returns):
        rule.take(number, score)
        if rule.over:
            record = rule.conclude(torch.nn.Linear(1, 1), total_steps=number, episode=number)
            written += [number] if record.kept else []
            rule.begin(number + 1, late=number + 1 >= 90, at=(number, number))
    assert written == td7(returns, 90)
    assert len([number for number in written if number < 90]) > 2
    assert len([number for number in written if number > 110]) > 2


def test_a_best_below_zero_is_lowered_too() -> None:
    rule = Assessment(AssessmentSettings(episodes=1))
    rule.begin(0, late=False, at=(0, 0))
    rule.take(0, -10.0)
    rule.conclude(torch.nn.Linear(1, 1), total_steps=1, episode=1)
    rule.begin(1, late=True, at=(1, 1))
    assert rule.best == pytest.approx(-11.0)
    rule.begin(1, late=True, at=(1, 1))
    assert rule.best == pytest.approx(-11.0)


def taken(run: TrainingRun) -> int:
    """Episodes that have assessed the policy which acts now."""
    assert run.assessment is not None
    return 0 if run.assessment.over else int(run.assessment.state_dict()["taken"])


@pytest.mark.parametrize("stages", [None, [Stage("A", actions=180), Stage("B", actions=180)]])
def test_a_run_that_is_stopped_in_an_assessment_goes_on_alike(
    tmp_path: Path, stages: list[Stage] | None
) -> None:
    settings = assessed(stages=stages)
    whole = train(tmp_path / "whole", settings)
    part = train(
        tmp_path, settings, lambda run: run.actions >= 240 and taken(run) > 0 and run.stop.ask()
    )
    state = read_checkpoint(tmp_path)
    assert not state["assessment"]["over"]
    assert state["waiting"] > 0
    resumed = go_on(tmp_path, settings)
    assert_same_run(resumed, whole)
    assert resumed.assessments == whole.assessments
    assert len(whole.assessments) > len(part.assessments) > 0
    mine, other = (load_policy(folder) for folder in (tmp_path, tmp_path / "whole"))
    assert mine.card == other.card
    observation = np.random.default_rng(0).random((5, 24), dtype=np.float32)
    np.testing.assert_array_equal(mine(observation), other(observation))


def test_another_world_has_a_best_of_its_own(tmp_path: Path) -> None:
    settings = assessed(stages=[Stage("A", actions=270), Stage("B", actions=270)])
    run = train(tmp_path, settings)
    first = next(each for each in run.assessments if each.total_steps > 270)
    assert first.best == -math.inf
    assert first.kept
    assert first.episodes == 5
    # Episodes that another world cut short are not waited for.
    assert first.total_steps < 270 + 3 * 12 * 3


def test_what_is_kept_is_what_is_evaluated_and_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = assessed()
    settings.evaluation.every, settings.evaluation.episodes = 180, 2
    found, seen = loop.evaluate_policy, []

    def evaluated(settings: TrainSettings, policy: torch.nn.Module, **named: Any) -> Any:
        seen.append(weights_of(policy))
        return found(settings, policy, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(loop, "evaluate_policy", evaluated)
    watched = Watched(tmp_path, settings)
    _, expected = oracle(watched)
    held = [begin for begin, kept, _ in expected if kept][-1]
    assert seen[-1].equal(watched.weights[held])
    assert not seen[-1].equal(watched.weights[-1])
    policy, run = load_policy(tmp_path), watched.run
    assert policy.card["steps"] == held * settings.robots
    ended = [each for each in run.records if each.total_steps <= held * settings.robots]
    assert policy.card["episodes"] == len(ended)
    observation = np.random.default_rng(0).random((5, 24), dtype=np.float32)
    assert run.assessment is not None
    kept: Any = run.assessment.kept
    wanted = kept.outputs({"observation": torch.from_numpy(observation)})["action"]
    np.testing.assert_allclose(policy(observation), wanted.detach().numpy(), atol=1e-5)
    table = read_table(tmp_path / "assessments.csv")
    assert table["kept"].tolist() == [each.kept for each in run.assessments]
    assert json.loads((tmp_path / "status.json").read_text())["finished"]


def test_a_run_without_the_rule_has_no_table_of_it(tmp_path: Path) -> None:
    train(tmp_path, tiny())
    assert not (tmp_path / "assessments.csv").exists()
    state = read_checkpoint(tmp_path)
    assert state["assessment"] is None
    # A checkpoint that is older than the rule goes on.
    del state["assessment"], state["assessments"], state["settings"]["assessment"]
    settings = tiny()
    settings.curriculum.stages.append(Stage("A", 1))
    assert train(tmp_path, settings, state=state).schedule.finished
