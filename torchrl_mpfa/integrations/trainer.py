"""Priorities in TorchRL's trainers: an optimization stepper that updates them after its step.

A trainer without an optimization stepper updates priorities in its ``post_loss`` stage. A trainer
with a stepper skips that stage in silence, and all transitions keep the priorities of fresh ones.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from tensordict import TensorDictBase
from torchrl.trainers import DefaultOptimizationStepper, OptimizationStepper, Trainer

from torchrl_mpfa.checks import kind_of
from torchrl_mpfa.losses import SUPPORTED, write_signals
from torchrl_mpfa.signals import TD_ERROR


class PriorityStepper(OptimizationStepper):
    """An optimization stepper that updates the priorities of each batch after its step.

    Another stepper takes the step itself, by default TorchRL's: all losses in one backward pass,
    one step of the trainer's optimizer. Target networks stay with the trainer. For a loss of
    TorchRL's own :func:`~torchrl_mpfa.write_signals` writes the signals in the batch, with the
    slope of the critic after the step; another loss writes its own. Then
    ``replay_buffer.update_tensordict_priority`` reads them, and not before.

    Args:
        stepper: Stepper that takes the step; by default
            :class:`~torchrl.trainers.DefaultOptimizationStepper`.

    Raises:
        TypeError: If ``stepper`` is not an optimization stepper.

    Examples:
        A trainer takes it as ``optimization_stepper``, where it has such an argument, or else by
        ``PriorityStepper().register(trainer)``; one with a stepper of its own, as ``TD3Trainer``,
        by ``PriorityStepper(trainer.optimization_stepper).register(trainer)``.

        >>> PriorityStepper().updates_replay_priority
        True
    """

    updates_replay_priority = True

    def __init__(self, stepper: OptimizationStepper | None = None) -> None:
        stepper = DefaultOptimizationStepper() if stepper is None else stepper
        if not isinstance(stepper, OptimizationStepper):
            raise TypeError(f"stepper must be an OptimizationStepper, got {kind_of(stepper)}")
        self.stepper = stepper
        self.priority_updates = 0
        """Number of batches whose priorities were updated."""

    @property
    def optimizer_step_count(self) -> int | None:
        """Steps of the optimizer if the inner stepper counts them, for hooks of TorchRL."""
        return getattr(self.stepper, "optimizer_step_count", None)

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """Take a step and update the priorities of its batch.

        Args:
            trainer: The trainer, with its loss, optimizer and replay buffer.
            sub_batch: A batch of its replay buffer, batch size ``[B]``.

        Returns:
            Detached values for the log.

        Raises:
            ValueError: If the trainer has no replay buffer.
            KeyError: If the loss did not write a signal that the sampler needs.
        """
        replay_buffer = getattr(trainer, "replay_buffer", None)
        if replay_buffer is None:
            raise ValueError(
                f"replay_buffer of the trainer must not be None, got {kind_of(trainer)}"
            )
        metrics = self.stepper.step(_WithoutPriorities(trainer), sub_batch)
        if sub_batch.get(TD_ERROR.key, None) is None and isinstance(trainer.loss_module, SUPPORTED):
            write_signals(sub_batch, trainer.loss_module)
        replay_buffer.update_tensordict_priority(sub_batch)
        self.priority_updates += 1
        # TorchRL's default stepper leaves the graph of its losses in them, and the trainer keeps
        # their averages.
        return metrics.detach()

    def register(self, trainer: Trainer, name: str = "optimization_stepper") -> None:
        """Make it the optimization stepper of a trainer; ``name`` is that of the inner state."""
        if getattr(trainer, "optimization_stepper", None) is not self.stepper:
            self.stepper.register(trainer, name)
        self._trainer = trainer
        trainer.optimization_stepper = self

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the inner stepper."""
        return self.stepper.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state of the inner stepper."""
        self.stepper.load_state_dict(state_dict)


class _WithoutPriorities:
    """A trainer for a stepper that would update priorities, without signals, as TD3's does."""

    def __init__(self, trainer: Trainer) -> None:
        self._trainer = trainer
        self.replay_buffer = SimpleNamespace(update_tensordict_priority=lambda batch: None)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._trainer, name)
