"""What is called on the way of a run: its log, its checkpoints, its progress, and one's own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensordict import TensorDictBase
from torch import Tensor

from training.records import EpisodeRecord, EvaluationRecord

if TYPE_CHECKING:
    from training.run.loop import TrainingRun


class Hook:
    """Methods that a run calls, each of which does nothing unless it is overridden.

    The run's own hooks come first (log, checkpoints, progress), then those that it was given, in
    their order. All are called once the robots have acted, the updates are made and the policy is
    evaluated, so that a run which a hook's error ended is saved and can be resumed bit for bit.
    What a hook keeps is not saved; ``run.records`` and ``run.evaluations`` are.

    A hook may look at all of the run, and call ``run.stop.ask()``. One that needs random numbers
    takes them from a generator of its own, or the training changes.

    Examples:
        >>> class StopAtFirstSuccess(Hook):
        ...     def on_episode(self, run, record):
        ...         if record.success:
        ...             run.stop.ask()
    """

    def on_begin(self, run: TrainingRun) -> None:
        """Called before the first iteration, also of a run that is resumed."""

    def on_update(self, run: TrainingRun, losses: dict[str, Tensor], batch: TensorDictBase) -> None:
        """Called after updates, every ``tracking.log_every`` actions.

        Args:
            run: The run.
            losses: What the last update gave.
            batch: Its transitions ``[B]`` and their ``"signals"``.
        """

    def on_episode(self, run: TrainingRun, record: EpisodeRecord) -> None:
        """Called for each episode that ended in an iteration."""

    def on_evaluation(self, run: TrainingRun, record: EvaluationRecord) -> None:
        """Called after an evaluation; ``record`` is also the last of ``run.evaluations``."""

    def on_iteration(self, run: TrainingRun) -> None:
        """Called after each iteration; if a stage of the curriculum is over, the next has begun."""

    def on_end(self, run: TrainingRun) -> None:
        """Called when the run is finished or was asked to stop, not after an error."""

    def close(self) -> None:
        """Release what the hook holds, however the run ended."""
