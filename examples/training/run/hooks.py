"""Hooks that a run calls, and the hook that shows its progress."""

from __future__ import annotations

import json
import sys
import time
from typing import TYPE_CHECKING, Any

from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from torchrl_mpfa.saving import write_text_atomically
from training import files
from training.records import EpisodeRecord, EvaluationRecord

if TYPE_CHECKING:
    from training.run.loop import TrainingRun

_RECENT = 100
"""Episodes whose success is shown."""
_REPORT_EVERY = 1.0
"""Time between two reports of progress [s]."""
_LINE_EVERY = 60.0
"""Time between two lines, where there is no terminal [s]."""


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


class Checkpoints(Hook):
    """Saves the run every ``checkpoint_every`` actions and at its end."""

    def on_iteration(self, run: TrainingRun) -> None:
        """Save if it is due."""
        if run.crossed(run.settings.checkpoint_every):
            run.save()

    def on_end(self, run: TrainingRun) -> None:
        """Save."""
        run.save()


class Progress(Hook):
    """Shows the progress of a run, and writes ``status.json`` in its folder.

    It is a bar in the terminal, and in a file a line a minute.
    """

    def __init__(self) -> None:
        self._bar: tqdm[Any] | None = None
        self._learned = False
        self._reported = 0.0
        self._line = time.monotonic()

    def on_begin(self, run: TrainingRun) -> None:
        """Show the bar."""
        done = run.schedule
        self._bar = tqdm(
            desc="train",
            total=done.total,
            initial=done.done,
            unit=done.unit,
            smoothing=0,
            disable=None,
        )

    def on_iteration(self, run: TrainingRun) -> None:
        """Move the bar, and report the success and the speed once a second."""
        assert self._bar is not None
        self._bar.update(run.schedule.done - self._bar.n)
        if run.updates and not self._learned:
            # From here on: the time left is not that of what the first update compiles.
            self._learned, self._bar.initial = True, self._bar.n
            self._bar.start_t = time.time()
        if time.monotonic() - self._reported > _REPORT_EVERY:
            self._reported = time.monotonic()
            self._show(run, report(run))

    def on_end(self, run: TrainingRun) -> None:
        """Report the end once all is saved: a reader may then remove the checkpoint."""
        assert self._bar is not None
        self._line = 0.0
        self._show(run, report(run, saved=True))
        self.close()

    def _show(self, run: TrainingRun, summary: str) -> None:
        """Show a summary beside the bar, or in a line if the last one is a minute old."""
        assert self._bar is not None
        if not self._bar.disable:
            self._bar.set_postfix_str(summary)
        elif time.monotonic() - self._line > _LINE_EVERY:
            self._line = time.monotonic()
            now = run.schedule
            print(f"{now.done} of {now.total} {now.unit}s, {summary}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """End the line of the bar."""
        if self._bar is not None:
            self._bar.close()


def report(run: TrainingRun, *, saved: bool = False) -> str:
    """Write ``status.json``; return the success and the speed in a few words."""
    summary = summary_of(run)
    status = {
        "unit": run.schedule.unit,
        "done": run.schedule.done,
        "total": run.schedule.total,
        "episodes": run.schedule.episodes,
        "steps": run.actions,
        "updates": run.updates,
        "summary": summary,
        "given_up": run.robots.given_up,
        "finished": run.schedule.finished and saved,
    }
    write_text_atomically(json.dumps(status), run.folder / files.STATUS)
    return summary


def summary_of(run: TrainingRun) -> str:
    """Return the recent success and the speed, in a few words."""
    speed = f"{run.updates / max(run.robots.elapsed(), 1e-9):.0f} updates/s"
    recent = run.records[-_RECENT:]
    if not recent:
        return f"no episode yet, {speed}"
    success = sum(record.success for record in recent) / len(recent)
    return f"{recent[-1].world}: success {success:.0%} of last {len(recent)}, {speed}"
