"""Value learning: what a frozen buffer holds, and that critics come to the values it has."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from benchmarks.values import ARMS, FrozenBuffer, capture, critic_values, frozen_buffers, learn
from benchmarks.values.arms import PLANNED, both_images
from benchmarks.values.frozen import FOLDER, read_frozen
from benchmarks.values.learning import SampleCounts, compared, make_frozen_learner, mirror
from tests.integration.tiny_runs import mostly_slow
from torchrl_mpfa.methods import METHODS, make_replay
from torchrl_mpfa.selection import SampledBatch
from training.settings.train import register


def test_critics_come_to_the_values_of_the_policy(walk: FrozenBuffer) -> None:
    first, last = learn(walk, "per", 0, marks=(20, 400))
    deviation = float(walk.value.std())
    assert last.rmse < 0.3 * deviation < first.rmse
    assert last.rank > 0.98 and last.returns_rank > 0.98
    assert abs(last.bias) < last.rmse


@pytest.mark.parametrize("marks", [(3,), (0,), (4, 2), ()])
def test_marks_that_no_update_reaches_are_rejected(marks, walk: FrozenBuffer) -> None:
    with pytest.raises(ValueError, match="marks must be even numbers of updates that rise"):
        next(learn(walk, "per", 0, marks=marks))


def test_the_policy_stays_as_it_was_frozen(walk: FrozenBuffer) -> None:
    learner = make_frozen_learner(walk, METHODS["la3p"], 0)
    action = learner.policy(walk.rows[:16].clone())["action"]
    for trains in ("both", "critic", "actor"):
        learner.update(SampledBatch(walk.rows[:64].clone(), trains=trains))
    assert learner.policy(walk.rows[:16].clone())["action"].equal(action)
    other = make_frozen_learner(walk, METHODS["per"], 7)
    assert other.policy(walk.rows[:16].clone())["action"].equal(action)


@pytest.mark.parametrize("arm", mostly_slow(sorted(ARMS), (*PLANNED, "la3p", "per/both_images")))
@pytest.mark.filterwarnings("ignore:positive_above='mean'")
def test_every_arm_of_the_table_learns_from_a_frozen_buffer(arm: str, walk: FrozenBuffer) -> None:
    made = ARMS[arm]
    buffer = frozen_buffers(FOLDER)[0] if made.mirrored else walk
    (found,) = learn(
        buffer, made.method, 0, marks=(8,), signals=made.signals, mirrored=made.mirrored
    )
    assert found.method == arm
    assert math.isfinite(found.rmse) and 0.0 < found.effective < 2.0 and 0.0 <= found.goals < 1.0


def test_a_signal_of_ones_own_decides_what_is_sampled(walk: FrozenBuffer) -> None:
    def last_cell(learner: object, batch: object) -> torch.Tensor:
        return (batch["observation"][:, -2] > 0).float()

    settings = replace(METHODS["per"], name="last", signals=["last"], eps=1e-4, alpha=1.0)
    (found,) = learn(walk, settings, 0, signals={"last": last_cell}, marks=(60,))
    (uniform,) = learn(walk, "uniform", 0, marks=(60,))
    assert found.goals > 3 * uniform.goals
    assert found.effective < 0.7


def test_a_replay_of_ones_own_is_used_as_it_is(walk: FrozenBuffer) -> None:
    asked = []

    def mine(buffer: FrozenBuffer, generator: torch.Generator):
        asked.append(buffer.name)
        return make_replay("rank_per", capacity=len(buffer), batch_size=64, generator=generator)

    (found,) = learn(walk, mine, 3, marks=(8,))
    assert asked == ["walk"] and found.method == "rank_per"
    assert found == next(learn(walk, mine, 3, marks=(8,)))


def test_the_values_of_critics_are_in_units_of_the_reward(walk: FrozenBuffer) -> None:
    learner = make_frozen_learner(walk, METHODS["uniform"], 0)
    inner = learner._learner
    inner.reward_scale = 1.0
    plain = critic_values(inner, walk.rows[:5])
    inner.reward_scale = 0.1
    assert critic_values(inner, walk.rows[:5]).allclose(10.0 * plain)
    assert plain.shape == (2, 5)


def test_the_effective_sample_is_that_of_the_probabilities() -> None:
    generator = torch.Generator().manual_seed(0)
    chance = torch.tensor([0.7, 0.1, 0.1, 0.1])
    counts = SampleCounts(torch.tensor([True, False, False, False]))
    for _ in range(40):
        index = chance.multinomial(256, replacement=True, generator=generator)
        counts(SampledBatch(TensorDict({"index": index}, [256])))
    assert counts.effective == pytest.approx(1 / (0.52 * 4), rel=0.03)
    assert counts.goals == pytest.approx(0.7, abs=0.02)


def test_differences_and_rank_correlations_are_what_numpy_has() -> None:
    rng = np.random.default_rng(0)
    value, reference = rng.normal(size=(2, 50))
    rmse, bias, rank = compared(torch.from_numpy(value), torch.from_numpy(reference))
    assert rmse == pytest.approx(float(np.sqrt(np.mean((value - reference) ** 2))))
    assert bias == pytest.approx(float(np.mean(value - reference)))
    ranks = [each.argsort().argsort() for each in (value, reference)]
    assert rank == pytest.approx(float(np.corrcoef(ranks)[0, 1]))


def test_a_buffer_is_read_as_it_was_written(walk: FrozenBuffer, tmp_path: Path) -> None:
    path = walk.save(tmp_path)
    read = read_frozen(path)
    assert (read.rows["next"] == walk.rows["next"]).all()
    assert read.rows["observation"].equal(walk.rows["observation"])
    assert read.rows["action"].allclose(walk.rows["action"], atol=1e-3)
    assert vars(read.learner) == vars(walk.learner)
    assert read.robots == walk.robots and len(read) == len(walk)
    before = path.read_bytes()
    assert read.save(tmp_path).read_bytes() == before
    assert [each.name for each in frozen_buffers(tmp_path)] == ["walk"]
    # Observations after an action are those of later rows, and written once.
    with np.load(path) as file:
        assert len(file["last_observation"]) < 0.3 * len(walk)


def test_the_buffers_of_the_project_are_of_runs_with_and_without_dense_rewards() -> None:
    found = {each.name: each for each in frozen_buffers(FOLDER)}
    assert len(found) == 12
    for name, buffer in found.items():
        reward, time, _ = name.split("-")
        assert len(buffer) == {"early": 6_000, "late": 20_000}[time]
        rewards = buffer.rows["next", "reward"].unique()
        assert (len(rewards) <= 3) == (reward == "sparse")
        assert buffer.value.isfinite().all() and buffer.spread < 0.5 * float(buffer.value.std())


def test_the_error_of_both_images_is_the_mean_of_two_that_are_alone() -> None:
    buffer = frozen_buffers(FOLDER)[0]
    learner = make_frozen_learner(buffer, METHODS["per"], 0)._learner
    learner.policy_noise = 0.0
    rows = buffer.rows[:32]
    alone = []
    for batch in (rows.clone(), mirror(chance=1.0)(rows.clone())):
        copy.deepcopy(learner).update(SampledBatch(batch, trains="critic"))
        alone.append(batch["signals", "td_error"])
    assert both_images(learner, rows).allclose(torch.stack(alone).mean(0), rtol=1e-4)
    assert not alone[0].allclose(alone[1])


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
