"""Kinds of worlds chosen by what can be learned in them, in a training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from mpfa_envs import GENERATORS, VectorNavigationEnv
from tests.integration.tiny_runs import OVERRIDES
from training.run.learnable import KINDS, LEVELS, LearnableWorlds
from training.run.loop import TrainingRun
from training.settings.command_line import composed


def noted(success: dict[str, float], episodes: int = 200) -> LearnableWorlds:
    worlds, rng = LearnableWorlds(), np.random.default_rng(0)
    for _ in range(episodes):
        for world, chance in success.items():
            worlds.note(world, success=bool(rng.random() < chance))
    return worlds


def test_kinds_that_always_or_never_succeed_are_chosen_less_than_the_others() -> None:
    worlds = noted({"rooms-1@0.1": 1.0, "mazes-2@0.9": 0.0, "bars-test-3@0.5": 0.5})
    chances = worlds.chances.view(len(KINDS), LEVELS)
    assert chances.sum().item() == pytest.approx(1.0)
    easy, hard, half = chances[0, 0], chances[5, 2], chances[2, 1]
    assert easy < 0.015 and hard < 0.015 < 0.04 < half
    # What was never met is as likely as what succeeds half of the time.
    assert half <= chances[1, 0]


def test_worlds_come_as_often_as_their_chance_says_and_are_of_their_level() -> None:
    worlds, rng = noted({"rooms-1@0.1": 1.0, "mazes-2@0.9": 0.0}), np.random.default_rng(1)
    counts = torch.zeros(len(KINDS), LEVELS)
    for _ in range(5000):
        kind, difficulty = worlds.choose(rng)
        counts[KINDS.index(kind), int(difficulty * LEVELS)] += 1
    assert set(KINDS) <= set(GENERATORS)
    assert counts.flatten() / 5000 == pytest.approx(worlds.chances.numpy(), abs=0.015)


def test_a_choice_needs_worlds_of_a_generator() -> None:
    env = VectorNavigationEnv(1, world="A", physics="kinematic")
    with pytest.raises(ValueError, match="choose needs worlds of a generator, got 'A'"):
        env.choose_worlds(lambda rng: ("mazes", 0.5))


def asked(folder: Path, *more: str, actions: int = 320):  # type: ignore[no-untyped-def]
    stages = f"curriculum.stages=[{{world: mixed, actions: {actions}}}]"
    own = ["environment.learnable_worlds=true", "robots=4", f"run_dir={folder}", stages]
    (found,) = composed([*OVERRIDES, *own, *more])
    return found


def test_a_run_chooses_its_worlds_and_goes_on_with_the_same_chances(tmp_path: Path) -> None:
    settings = asked(tmp_path, "environment.max_steps=20")
    run = TrainingRun(settings, tmp_path)
    run.train()
    state = run.robots.state_dict()
    chances = state["learnable"]["success"]
    assert not chances.eq(0.5).all()  # Most episodes fail.
    again = LearnableWorlds()
    again.load_state_dict(state["learnable"])
    assert again.chances.equal(run.robots._learnable.chances)  # type: ignore[union-attr]
    run.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["curriculum.stages=[{world: A, actions: 320}]"], "world must be mixed with environment"),
        (["ray.workers=1"], "environment.learnable_worlds must be False with ray.workers=1"),
    ],
)
def test_what_cannot_choose_its_worlds_is_rejected(
    tmp_path: Path, changes: list[str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        asked(tmp_path, *changes)
