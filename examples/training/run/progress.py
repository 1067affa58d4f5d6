"""How far a run is: a bar in the terminal, and ``status.json`` in its folder."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from torchrl_mpfa.files import write_text_atomically
from training import files
from training.run.hooks import Hook

if TYPE_CHECKING:
    from training.run.loop import TrainingRun

_RECENT = 100
"""Episodes whose success is shown."""
_TELL_EVERY = 1.0
"""Between two words on how far the run is [s]."""


class Progress(Hook):
    """Says how far the run is, to whoever looks at the terminal or reads its folder."""

    def __init__(self) -> None:
        self._bar: tqdm[Any] | None = None
        self._told = 0.0

    def on_begin(self, run: TrainingRun) -> None:
        """Show the bar."""
        done = run.schedule
        self._bar = tqdm(total=done.total, initial=done.done, unit=done.unit, smoothing=0.05)

    def on_iteration(self, run: TrainingRun) -> None:
        """Move the bar, and say how it goes if that was not done for a while."""
        assert self._bar is not None
        self._bar.update(run.schedule.done - self._bar.n)
        if time.monotonic() - self._told > _TELL_EVERY:
            self._told = time.monotonic()
            self._bar.set_postfix_str(tell(run))

    def on_end(self, run: TrainingRun) -> None:
        """Say that all is saved: whoever reads that a run is finished may remove its checkpoint."""
        assert self._bar is not None
        self._bar.set_postfix_str(tell(run, saved=True))
        self.close()

    def close(self) -> None:
        """End the line of the bar."""
        if self._bar is not None:
            self._bar.close()


def tell(run: TrainingRun, *, saved: bool = False) -> str:
    """Write how far the run is, and say how it goes in a few words."""
    summary = summary_of(run)
    status = {
        "unit": run.schedule.unit,
        "done": run.schedule.done,
        "total": run.schedule.total,
        "episodes": run.schedule.episodes,
        "steps": run.actions,
        "summary": summary,
        "given_up": run.robots.given_up,
        "finished": run.schedule.finished and saved,
    }
    write_text_atomically(json.dumps(status), run.folder / files.STATUS)
    return summary


def summary_of(run: TrainingRun) -> str:
    """How it goes, in a few words."""
    speed = f"{run.updates / max(run.robots.elapsed(), 1e-9):.0f} updates/s"
    recent = run.records[-_RECENT:]
    if not recent:
        return f"no episode yet, {speed}"
    success = sum(record.success for record in recent) / len(recent)
    return f"{recent[-1].world}: success {success:.0%} of last {len(recent)}, {speed}"
