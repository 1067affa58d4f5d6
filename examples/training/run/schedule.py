"""How far a run is in its curriculum."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from training.settings.train import Stage


class Schedule:
    """Counts the actions and the episodes of a run, and knows in which stage it is.

    Args:
        stages: The stages, all of which count episodes or all of which count actions.

    Examples:
        >>> schedule = Schedule([Stage("A", episodes=1), Stage("B", episodes=3)])
        >>> schedule.count(actions=16, episodes=1)
        >>> schedule.advance()
        True
        >>> schedule.world, schedule.fraction, schedule.finished
        ('B', 0.25, False)
    """

    def __init__(self, stages: Sequence[Stage]) -> None:
        self.stages = list(stages)
        self.unit = "episode" if self.stages[0].episodes else "action"
        self.total = sum(stage.length for stage in self.stages)
        """Episodes or actions of all stages."""
        self.stage = 0
        """Number of the present stage."""
        self.actions = 0
        self.episodes = 0
        self._in_stage = 0

    @property
    def world(self) -> str:
        """World of the present stage."""
        return self.stages[self.stage].world

    @property
    def done(self) -> int:
        """Episodes or actions that count so far."""
        before = sum(stage.length for stage in self.stages[: self.stage])
        return min(before + self._in_stage, self.total)

    @property
    def fraction(self) -> float:
        """Share of the run that is done, from 0 to 1."""
        return self.done / self.total

    @property
    def finished(self) -> bool:
        """True if all stages are over."""
        return self.done == self.total

    def count(self, *, actions: int, episodes: int) -> None:
        """Count what an iteration brought."""
        self.actions += actions
        self.episodes += episodes
        self._in_stage += episodes if self.unit == "episode" else actions

    def advance(self) -> bool:
        """Go to the next stage if the present one is over and not the last."""
        is_last = self.stage == len(self.stages) - 1
        if is_last or self._in_stage < self.stages[self.stage].length:
            return False
        # What ended beyond the stage's length, of several robots, is not carried over.
        self.stage, self._in_stage = self.stage + 1, 0
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return the progress of the run."""
        return {
            "stage": self.stage,
            "in_stage": self._in_stage,
            "actions": self.actions,
            "episodes": self.episodes,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the progress of a run, which may have more stages now."""
        self.stage, self._in_stage = state["stage"], state["in_stage"]
        self.actions, self.episodes = state["actions"], state["episodes"]
