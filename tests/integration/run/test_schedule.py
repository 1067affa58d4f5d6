"""How far a run is: stages, what counts in them, and what does not."""

from __future__ import annotations

import pytest

from training.run.schedule import Schedule
from training.settings.train import Stage


@pytest.mark.parametrize(("unit", "share"), [("actions", 0.4), ("episodes", 0.1)])
def test_what_is_beyond_a_stage_does_not_count_in_the_next(unit: str, share: float) -> None:
    stages = [Stage("A", **{unit: 10}), Stage("B", **{unit: 40})]
    schedule = Schedule(stages)
    assert not schedule.advance()
    schedule.count(actions=20, episodes=5)
    if unit == "episodes":
        assert schedule.fraction == share
        return
    assert schedule.advance() and schedule.world == "B"
    assert schedule.done == 10 and (schedule.actions, schedule.episodes) == (20, 5)
    schedule.count(actions=10, episodes=0)
    assert schedule.fraction == share
    schedule.count(actions=99, episodes=0)
    assert schedule.finished and schedule.fraction == 1.0 and not schedule.advance()
