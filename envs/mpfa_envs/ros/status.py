"""What has become of a goal, as messages: the status as text and code, and the feedback."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

if TYPE_CHECKING:
    from mpfa_envs.ros.controller import State
    from mpfa_envs.ros.navigator import Progress

CODES: Final[dict[State, int]] = {
    "idle": 0,
    "accepted": 1,
    "driving": 2,
    "waiting": 2,
    "arrived": 4,
    "canceled": 5,
    "given up": 6,
    "rejected": 6,
}
"""The codes of states, those of ``action_msgs/GoalStatus``."""
_LEVELS: Final[dict[State, bytes]] = {
    "waiting": DiagnosticStatus.WARN,
    "given up": DiagnosticStatus.ERROR,
    "rejected": DiagnosticStatus.ERROR,
}


class Status(NamedTuple):
    """What has become of the goal, and why."""

    state: State
    reason: str
    """Figures follow a colon."""
    note: str
    """What is worth saying though the robot drives on; empty without."""
    goal: int
    """The number of the goal, from 1; 0 before the first one."""

    @property
    def kind(self) -> tuple[State, str, str, int]:
        """All but figures."""
        reason, note = (text.partition(":")[0] for text in (self.reason, self.note))
        return self.state, reason, note, self.goal

    def message(self, name: str) -> DiagnosticStatus:
        """As a ``diagnostic_msgs/DiagnosticStatus`` of a node."""
        level = _LEVELS.get(self.state, DiagnosticStatus.WARN if self.note else DiagnosticStatus.OK)
        values = {"state": self.state, "code": str(CODES[self.state]), "reason": self.reason}
        values |= {"note": self.note, "goal": str(self.goal)}
        return DiagnosticStatus(
            level=level,
            name=f"{name}: goal",
            message="; ".join(filter(None, (self.reason, self.note))),
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )


def feedback(progress: Progress) -> Float64MultiArray:
    """Distance left [m], time [s] and recoveries, in this order, with their names as labels."""
    message = Float64MultiArray(data=[float(value) for value in progress])
    message.layout.dim = [
        MultiArrayDimension(label=name, size=1, stride=1) for name in progress._fields
    ]
    return message
