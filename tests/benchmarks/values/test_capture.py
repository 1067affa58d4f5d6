"""Frozen buffers are made of a run that is stopped, and of what its policy gets alone."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from benchmarks.values import capture, learn
from benchmarks.values.frozen import read_frozen
from training.settings.train import register

GAMMA = 0.5


class Countdown:
    """Robots whose episodes end after four steps, the first's by a goal, the second's by time."""

    def set_seed(self, seed: int) -> None:
        self.steps = 0

    def reset(self) -> TensorDict:
        return TensorDict({"observation": torch.zeros(2, 1)}, [2])

    def step_and_maybe_reset(self, state: TensorDict) -> tuple[TensorDict, TensorDict]:
        self.steps += 1
        done = torch.full((2, 1), self.steps % 4 == 0)
        after = {
            "observation": torch.full((2, 1), float(self.steps)),
            "reward": torch.tensor([[8.0 * bool(done[0])], [1.0]]),
            "done": done,
            "terminated": done & torch.tensor([[True], [False]]),
        }
        return state.clone().set("next", after), TensorDict(after, [2]).select("observation")


def test_returns_are_discounted_and_end_with_the_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture, "_STEPS", 12)

    def policy(state: TensorDict) -> TensorDict:
        return state.set("action", state["observation"].clone())

    found = capture.monte_carlo(Countdown(), policy, gamma=GAMMA, seed=0)
    # Of the second robot nothing is known beyond the time limit, when half is still to come.
    assert found["value"].tolist() == [1.0, 2.0, 4.0, 8.0] * 3
    assert found["observation"].equal(found["action"])
    monkeypatch.setattr(capture, "_CUT", 0.2)
    found = capture.monte_carlo(Countdown(), policy, gamma=GAMMA, seed=0)
    assert found["value"].tolist() == [1.0, 1.875, 2.0, 1.75, 4.0, 8.0] * 3


def test_every_buffer_is_of_a_run_that_no_table_has() -> None:
    names = [source.name for source in capture.SOURCES_OF_ALL]
    assert len(set(names)) == len(names) == 12
    assert {source.seed for source in capture.SOURCES_OF_ALL} == set(range(2000, 2012))


@pytest.mark.slow
def test_a_run_becomes_a_buffer_that_critics_learn_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register()
    for name, value in {"_STEPS": 200, "_LONG": 40, "_CRITICS": 2, "_RETURNS": 50}.items():
        monkeypatch.setattr(capture, name, value)
    monkeypatch.setattr(capture, "TIMES", {"early": 640})
    frozen = capture.capture(capture.SOURCES_OF_ALL[2])
    assert len(frozen) == 640 and frozen.learner.gamma == 0.97
    assert frozen.value.std() > 0 and frozen.spread > 0
    assert set(frozen.returns.keys()) == {"observation", "action", "value", "long"}
    read = read_frozen(frozen.save(tmp_path))
    assert (read.rows == frozen.rows).all()
    (found,) = learn(read, "reaper", 0, marks=(20,))
    assert found.rmse > 0
