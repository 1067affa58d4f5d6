"""DDPG on one page: it learns, keeps its best policy, and writes one that other scripts drive."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import ddpg
from mpfa_envs import Policy, load_policy
from training.evaluating import as_trained, drive


def train(folder: Path, *, seed: int = 0, actions: int = 384) -> Policy:
    file = ddpg.main(["--seed", str(seed), "--actions", str(actions), "--out", str(folder)])
    return load_policy(file)


@pytest.fixture
def briefly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ddpg, "BATCH_SIZE", 32)
    monkeypatch.setattr(ddpg, "EPISODES", 1)


@pytest.mark.usefixtures("briefly")
def test_a_trained_policy_drives_as_evaluate_drives_it(tmp_path: Path) -> None:
    policy = train(tmp_path)
    assert policy.card == {
        **{"learner": "ddpg", "method": "mpfa_per", "filter": True},
        **{"seed": 0, "steps": 384},
    }
    [driven] = drive(as_trained(policy), ["A"], episodes=2, seed=0, physics=None, progress=False)
    assert len(driven.results) == 2


@pytest.mark.usefixtures("briefly")
def test_the_seed_decides_the_policy_to_the_last_bit(tmp_path: Path) -> None:
    seen = np.random.default_rng(0).uniform(-1, 1, (50, 45)).astype(np.float32)
    one, same, other = (
        train(tmp_path / str(place), seed=seed)(seen) for place, seed in enumerate((3, 3, 4))
    )
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


@pytest.mark.usefixtures("briefly")
def test_the_policy_of_the_best_evaluation_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    judged: list[Policy] = []
    successes = {"mixed:validation": [0.2, 0.6, 0.4], "mixed:test": [0.5]}

    def success_of(policy: Policy, worlds: str) -> float:
        judged.append(policy)
        return successes[worlds].pop(0)

    monkeypatch.setattr(ddpg, "EVALUATE_EVERY", 128)
    monkeypatch.setattr(ddpg, "success_of", success_of)
    kept = train(tmp_path)
    seen = np.ones(45, dtype=np.float32)
    assert len(judged) == 4
    assert judged[3] is judged[1]
    np.testing.assert_array_equal(kept(seen), judged[1](seen))
    assert re.findall(r"\d+(?=%)", capsys.readouterr().out) == ["60", "50"]


def test_it_needs_nothing_but_the_packages_and_a_progress_bar() -> None:
    page = Path(ddpg.__file__).read_text(encoding="utf-8")
    found = set(re.findall(r"^(?:from|import) (\w+)", page, re.MULTILINE))
    standard = {"__future__", "argparse", "collections", "functools", "pathlib", "typing"}
    assert found - standard == {
        "mpfa_envs",
        "tensordict",
        "torch",
        "torchrl",
        "torchrl_mpfa",
        "tqdm",
    }
    assert len(page.splitlines()) <= 200


@pytest.mark.slow
def test_it_reaches_nine_of_ten_goals_in_the_validation_worlds(tmp_path: Path) -> None:
    assert ddpg.success_of(train(tmp_path, actions=40_000), "mixed:validation") >= 0.9
