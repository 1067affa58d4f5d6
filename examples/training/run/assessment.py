"""TD7's rule of which policy a run keeps: held fixed, assessed by whole episodes, by their worst.

Fujimoto et al. 2023, "For SALE: State-Action Representation Learning for Deep Reinforcement
Learning", https://arxiv.org/abs/2306.02451, read from the authors' code; ``docs/tuning.md``
says what is different with many robots.
"""

from __future__ import annotations

import copy
import math
from typing import Any

from torch import nn

from training.records import AssessmentRecord, EpisodeRecord
from training.settings.train import AssessmentSettings

_AT_THE_END = {"success": 10.0, "collision": -5.0}
"""What Eq. (25) pays at the end of an episode; nothing for a timeout."""


class Assessment:
    """Decides when the policy may be updated, and keeps the one whose worst episode was best.

    Args:
        settings: How many episodes, and how they are scored.

    Examples:
        >>> assessment = Assessment(AssessmentSettings(episodes=2, early_share=0.0))
        >>> assessment.begin(7, late=True, at=(5, 1000))
        >>> assessment.take(7, -1.0), assessment.take(6, -9.0), assessment.over
        (None, None, False)
        >>> assessment.take(8, 3.0)
        >>> assessment.over, assessment.passed, assessment.least
        (True, True, -1.0)
    """

    def __init__(self, settings: AssessmentSettings) -> None:
        self.settings = settings
        self.over = True
        """Whether nothing more is to be known of the policy, and updates are due."""
        self.best = -math.inf
        """Least score of the policy that was kept."""
        self.kept: nn.Module | None = None
        self.kept_at = (0, 0)
        """Episodes and actions of the run after which that policy was held fixed."""
        self.least = math.inf
        self._late = False
        self._first, self._taken = 0, 0
        self._at = (0, 0)

    @property
    def passed(self) -> bool:
        """Whether the policy was assessed, and is no worse than the one that was kept."""
        return self.over and self._taken > 0 and self.least >= self.best

    def begin(self, first: int, *, late: bool, at: tuple[int, int]) -> None:
        """Assess a policy that stays as it is until :attr:`over`."""
        if late and not self._late and math.isfinite(self.best):
            # Of a negative score TD7's product would be higher, not lower.
            self.best -= (1.0 - self.settings.best_factor) * abs(self.best)
        self._late |= late
        self.over, self.least = False, math.inf
        self._first, self._taken, self._at = first, 0, at

    def take(self, number: int, score: float) -> None:
        """Take note of an episode that ended.

        The episodes that count are those that began first, not those that ended first: of many
        that go on at once the first to end are collisions.

        Args:
            number: Of the episode, in the order in which episodes began.
            score: Its score.
        """
        settings = self.settings
        wanted = settings.episodes if self._late else settings.early_episodes
        if self.over or not self._first <= number < self._first + wanted:
            return
        self.least, self._taken = min(self.least, score), self._taken + 1
        self.over = self.least < self.best or self._taken == wanted

    def score(self, record: EpisodeRecord) -> float:
        """Score of an episode."""
        if self.settings.by == "return":
            return record.reward
        return sum(pays for name, pays in _AT_THE_END.items() if getattr(record, name))

    def conclude(self, policy: nn.Module, *, total_steps: int, episode: int) -> AssessmentRecord:
        """Keep the policy if it passed, and tell what was found."""
        record = AssessmentRecord(
            total_steps=total_steps,
            episode=episode,
            episodes=self._taken,
            least=self.least,
            best=self.best,
            kept=self.passed,
        )
        if self.passed:
            self.best, self.kept_at = self.least, self._at
            self.kept = copy.deepcopy(policy)
        return record

    def begin_stage(self) -> None:
        """Forget the best score, as those of another world say nothing here."""
        self.over, self._taken, self.best = True, 0, -math.inf

    def state_dict(self) -> dict[str, Any]:
        """What it depends on which policy is kept, and that policy."""
        return {
            "over": self.over,
            "best": self.best,
            "least": self.least,
            "late": self._late,
            "first": self._first,
            "taken": self._taken,
            "at": list(self._at),
            "kept_at": list(self.kept_at),
            "kept": None if self.kept is None else dict(self.kept.state_dict()),
        }

    def load_state_dict(self, state: dict[str, Any], policy: nn.Module) -> None:
        """Go on where :meth:`state_dict` was called."""
        self.over, self.best, self.least = state["over"], state["best"], state["least"]
        self._late, self._first, self._taken = state["late"], state["first"], state["taken"]
        self._at, self.kept_at = tuple(state["at"]), tuple(state["kept_at"])
        if state["kept"] is not None:
            self.kept = copy.deepcopy(policy)
            self.kept.load_state_dict(state["kept"])
