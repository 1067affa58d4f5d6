"""Parts for TorchRL's trainers: priorities that are updated whatever takes the optimization step.

A trainer without an optimization stepper updates priorities in its ``post_loss`` stage. With one
it skips that stage and says nothing: replay then goes on with the priorities of fresh transitions.
"""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.data.replay_buffers import PrioritizedSampler
from torchrl.trainers import (
    DefaultOptimizationStepper,
    OptimizationStepper,
    Trainer,
    TrainerHookBase,
)

from torchrl_mpfa.samplers.signal_sampler import SignalSampler


class PriorityStepper(OptimizationStepper):
    """An optimization stepper that updates the priorities of each batch after its step.

    It leaves the step itself to another stepper, by default TorchRL's: all losses in one backward
    pass, one step of the trainer's optimizer. Target networks stay with the trainer. The loss
    writes the signals in the batch, and ``replay_buffer.update_tensordict_priority`` reads them.

    Args:
        stepper: What takes the step; by default
            :class:`~torchrl.trainers.DefaultOptimizationStepper`.

    Raises:
        TypeError: If ``stepper`` is not an optimization stepper.
        ValueError: If it updates priorities already.

    Examples:
        A trainer takes it as ``optimization_stepper``, where it has such an argument, or else by
        ``PriorityStepper().register(trainer)``.

        >>> PriorityStepper().updates_replay_priority
        True
    """

    updates_replay_priority = True

    def __init__(self, stepper: OptimizationStepper | None = None) -> None:
        stepper = DefaultOptimizationStepper() if stepper is None else stepper
        if not isinstance(stepper, OptimizationStepper):
            raise TypeError(f"stepper must be an OptimizationStepper, got {_name(stepper)}")
        if _declares_updates(stepper):
            raise ValueError(f"stepper must not update priorities itself, got {_name(stepper)}")
        self.stepper = stepper
        self.priority_updates = 0
        """Number of batches whose priorities were updated."""

    @property
    def optimizer_step_count(self) -> int | None:
        """Steps of the optimizer, where the inner stepper counts them; hooks of TorchRL ask."""
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
        replay_buffer = buffer_of(trainer)
        metrics = self.stepper.step(trainer, sub_batch)
        replay_buffer.update_tensordict_priority(sub_batch)
        self.priority_updates += 1
        # TorchRL's default stepper leaves the graph of its losses in them, and the trainer keeps
        # their averages.
        return metrics.detach()

    def register(self, trainer: Trainer, name: str = "optimization_stepper") -> None:
        """Make it the optimization stepper of a trainer; ``name`` is that of the inner state."""
        self.stepper.register(trainer, name)
        self._trainer = trainer
        trainer.optimization_stepper = self

    def state_dict(self) -> dict[str, Any]:
        """State of the inner stepper."""
        state: dict[str, Any] = self.stepper.state_dict()
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        self.stepper.load_state_dict(state_dict)


class PriorityGuard(TrainerHookBase):
    """A hook that stops a trainer whose prioritized replay never gets a priority.

    Before the training it asks the optimization stepper (:func:`check_priority_updates`); after
    the first optimization steps it looks whether a :class:`~torchrl_mpfa.SignalSampler` was
    updated indeed, which finds a trainer without the hook that updates as well.

    Args:
        replay_buffer: The buffer; by default that of the trainer.

    Examples:
        >>> guard = PriorityGuard()  # then guard.register(trainer), before trainer.train()
        >>> guard.state_dict()
        {}
    """

    def __init__(self, replay_buffer: Any | None = None) -> None:
        self.replay_buffer = replay_buffer
        self._trainer: Trainer | None = None

    def register(self, trainer: Trainer, name: str = "priority_guard") -> None:
        """Watch a trainer; there is no state to save under the name."""
        if _updates_remotely(trainer):
            return
        if self.replay_buffer is None:
            self.replay_buffer = buffer_of(trainer)
        self._trainer = trainer
        trainer.register_op("setup", self._before)
        trainer.register_op("post_optim", self._after_step)

    def _before(self) -> None:
        check_priority_updates(self._trainer, replay_buffer=self.replay_buffer)

    def _after_step(self) -> None:
        sampler = getattr(self.replay_buffer, "sampler", None)
        if not isinstance(sampler, SignalSampler) or sampler.weights:
            return
        stepper = getattr(self._trainer, "optimization_stepper", None)
        cause = (
            "no hook does at the stage 'post_loss' (ReplayBufferTrainer.update_priority)"
            if stepper is None
            else f"step() of {_name(stepper)} does not call it"
        )
        raise RuntimeError(
            f"an optimization step was taken and no priority updated: "
            f"replay_buffer.update_tensordict_priority(batch) must be called after the loss, but "
            f"{cause}; PriorityStepper does"
        )

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the guard has no state."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing: the guard has no state."""


def check_priority_updates(trainer: Trainer, *, replay_buffer: Any | None = None) -> None:
    """Reject a trainer whose optimization stepper leaves priorities as they are.

    Args:
        trainer: The trainer.
        replay_buffer: The buffer; by default that of the trainer.

    Raises:
        ValueError: If there is no replay buffer.
        RuntimeError: If the buffer's sampler samples by priorities, and the stepper does not
            declare ``updates_replay_priority``.
    """
    if _updates_remotely(trainer):
        return
    buffer = buffer_of(trainer) if replay_buffer is None else replay_buffer
    stepper = getattr(trainer, "optimization_stepper", None)
    sampler = getattr(buffer, "sampler", None)
    if stepper is None or not isinstance(sampler, PrioritizedSampler) or _declares_updates(stepper):
        return
    raise RuntimeError(
        f"optimization_stepper {_name(stepper)} does not update priorities, and a trainer with a "
        f"stepper skips the stage that would: {_name(sampler)} would sample by the priorities of "
        f"fresh transitions forever. Wrap it, PriorityStepper({_name(stepper)}(...)), or call "
        "trainer.replay_buffer.update_tensordict_priority(sub_batch) in its step() and set "
        "updates_replay_priority = True"
    )


def buffer_of(trainer: Trainer) -> Any:
    """The replay buffer of a trainer, which must have one."""
    replay_buffer = getattr(trainer, "replay_buffer", None)
    if replay_buffer is None:
        raise ValueError(f"replay_buffer of the trainer must not be None, got {_name(trainer)}")
    return replay_buffer


def _declares_updates(stepper: OptimizationStepper) -> bool:
    return bool(getattr(stepper, "updates_replay_priority", False))


def _updates_remotely(trainer: Trainer) -> bool:
    """Whether a learner elsewhere takes the steps: it updates what the stepper does not."""
    return getattr(trainer, "learner_backend", "local") == "ray"


def _name(thing: object) -> str:
    return type(thing).__name__
