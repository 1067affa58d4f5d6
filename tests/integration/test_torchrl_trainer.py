"""TorchRL's ``DDPGTrainer`` with our parts: priorities are updated, or there is an error."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.trainers import (
    DefaultOptimizationStepper,
    MixedPrecisionOptimizationStepper,
    Trainer,
)
from torchrl.trainers.algorithms import DDPGTrainer

from mpfa_envs import make_navigation_env
from torchrl_mpfa import (
    ActorCritic,
    MPFASampler,
    SignalReplayBuffer,
    SignalTensorStorage,
    make_actor,
    make_critic,
    run_updates,
)
from torchrl_mpfa.integrations.trainer import PriorityStepper
from torchrl_trainer import Sizes, main, make_trainer

pytestmark = [
    pytest.mark.filterwarnings("ignore:DDPGTrainer is an experimental"),
    # Stages that the trainer itself uses.
    pytest.mark.filterwarnings("ignore:The '.*' hook stage:FutureWarning"),
    pytest.mark.filterwarnings("ignore:OptimizerHook:FutureWarning"),
]
TINY = Sizes(
    frames=60, frames_per_batch=20, steps_per_batch=3, capacity=100, batch_size=4, width=16
)


def tiny_trainer(seed: int = 0) -> DDPGTrainer:
    return make_trainer(TINY, seed=seed, progress_bar=False)


def known_and_replayed(trainer: Trainer, *names: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Which slots have these learned signals, and which were in a batch."""
    table = trainer.replay_buffer.sampler.table
    rows = table.rows[: table.size]
    learned = [table.column[name] for name in names or ("td_error", "action_gradient")]
    return rows[:, learned].isfinite().all(1), rows[:, table.count_column] > 0


def assert_learned(trainer: Trainer, *names: str) -> None:
    """The transitions that were replayed have these signals, and no others have."""
    known, replayed = known_and_replayed(trainer, *names)
    assert known.equal(replayed)
    assert replayed.any()
    assert trainer.replay_buffer.sampler.weights


def test_many_robots_in_the_worlds_of_a_generator_are_collected_flat() -> None:
    trainer = make_trainer(TINY, world="mixed", num_envs=5, progress_bar=False)
    PriorityStepper().register(trainer)
    trainer.train()
    assert trainer.collected_frames == len(trainer.replay_buffer) == 60
    assert trainer.replay_buffer[:]["observation"].shape == (60, 24)
    robots = trainer.replay_buffer[:]["collector", "traj_ids"][:20].unique()
    assert len(robots) >= 5
    assert_learned(trainer)


def test_the_stepper_updates_the_signals_of_every_transition_that_is_replayed() -> None:
    trainer = tiny_trainer()
    stepper = PriorityStepper()
    stepper.register(trainer)
    trainer.train()
    known, replayed = known_and_replayed(trainer)
    assert known.equal(replayed)
    assert 0 < int(replayed.sum()) < len(trainer.replay_buffer) == 60
    assert stepper.priority_updates == trainer._optim_count == 9
    weights = trainer.replay_buffer.sampler.weights
    assert set(weights) == {"reward", "td_error", "action_gradient"}
    assert sum(weights.values()) == pytest.approx(1)


def test_without_a_stepper_the_trainers_own_hook_asks_for_the_signals() -> None:
    trainer = tiny_trainer()
    with pytest.raises(KeyError, match=r"signal 'td_error' is missing: .*write_signals"):
        trainer.train()


def test_the_trap_is_there_a_silent_stepper_leaves_all_priorities_as_they_were() -> None:
    trainer = tiny_trainer()
    trainer.optimization_stepper = DefaultOptimizationStepper()
    trainer.train()
    known, replayed = known_and_replayed(trainer)
    assert replayed.any()
    assert not known.any()
    assert trainer.replay_buffer.sampler.weights == {}


def test_another_stepper_takes_the_step_where_one_is_given() -> None:
    trainer = tiny_trainer()
    inner = MixedPrecisionOptimizationStepper(trainer.optimizer)
    stepper = PriorityStepper(inner)
    assert stepper.optimizer_step_count == 0
    stepper.register(trainer)
    trainer.train()
    assert (stepper.priority_updates, stepper.optimizer_step_count) == (9, 9)
    state = stepper.state_dict()
    assert state["optimizer_step_count"] == 9
    fresh = PriorityStepper(MixedPrecisionOptimizationStepper(trainer.optimizer))
    fresh.load_state_dict(state)
    assert fresh.optimizer_step_count == 9


def test_the_values_for_the_log_keep_no_graph() -> None:
    trainer = tiny_trainer()
    seen: list[TensorDictBase] = []
    stepper = PriorityStepper()
    step = stepper.step

    def remember(trainer: Trainer, batch: TensorDictBase) -> TensorDictBase:
        seen.append(step(trainer, batch))
        return seen[-1]

    stepper.step = remember
    stepper.register(trainer)
    trainer.train()
    assert not any(value.requires_grad for value in seen[0].values())


def test_a_stepper_that_cannot_be_wrapped_raises() -> None:
    with pytest.raises(TypeError, match="stepper must be an OptimizationStepper, got str"):
        PriorityStepper("step")


def test_a_step_without_a_replay_buffer_raises_before_it_is_taken() -> None:
    with pytest.raises(ValueError, match="replay_buffer of the trainer must not be None"):
        PriorityStepper().step(SimpleNamespace(loss_module=None), None)


def test_the_example_trains_and_says_what_happened(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--frames", "200", "--no-progress"])
    printed = capsys.readouterr().out
    assert "frames collected        200" in printed
    assert "steps of the optimizer  50" in printed
    assert "updates of priorities   50" in printed
    assert all(f"signal {name}" in printed for name in ("reward", "td_error", "action_gradient"))


def test_the_code_of_the_page_runs() -> None:
    page = Path(__file__).parents[2] / "docs" / "torchrl_trainer.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    assert names["trainer"].replay_buffer.sampler.weights


def test_a_collector_of_many_robots_acts_by_the_weights_that_were_learned() -> None:
    env = make_navigation_env("A", num_envs=2, physics="kinematic", seed=0)
    actor = make_actor(24, 2, width=8)
    learner = ActorCritic(actor, make_critic(24, 2, width=8), actor_lr=0.1)
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(100), sampler=MPFASampler(100), batch_size=4
    )
    collector = Collector(
        env, actor, frames_per_batch=8, total_frames=24, auto_register_policy_transforms=True
    )
    for steps in collector:
        # The weights have not changed since these actions were taken: what acts is what learns.
        expected = actor(steps.select("observation").clone())["action"]
        torch.testing.assert_close(steps["action"], expected)
        buffer.extend(steps.reshape(-1))
        run_updates(buffer, learner, updates=3)
