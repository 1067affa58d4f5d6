"""A goal as an action: ``NavigateToPose`` of Nav2, or another type of the same meaning."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.duration import Duration
from rclpy.task import Future

if TYPE_CHECKING:
    from collections.abc import Callable

    from mpfa_envs.ros.navigator import Progress
    from mpfa_envs.ros.status import Status

UNREACHABLE: Final = 208
"""``error_code`` of a goal that was rejected, ``NO_VALID_PATH`` of Nav2's planners,"""
GIVEN_UP: Final = 105
"""and of one that was given up, ``FAILED_TO_MAKE_PROGRESS`` of its controllers; 0 is none."""


class ActionType(Protocol):
    """What this node needs to know of a type of actions."""

    kind: Any
    """The type, with ``Goal``, ``Feedback`` and ``Result``."""

    def place(self, goal: Any) -> Any:
        """The ``geometry_msgs/PoseStamped`` of a goal."""

    def feedback(self, progress: Progress, place: Any) -> Any:
        """A feedback message; the place is a ``geometry_msgs/PoseStamped``."""

    def result(self, status: Status) -> Any:
        """A result message."""


class NavigateToPose:
    """The action of ``nav2_msgs``."""

    def __init__(self) -> None:
        from nav2_msgs.action import NavigateToPose as Kind

        self.kind = Kind

    def place(self, goal: Any) -> Any:
        """The ``geometry_msgs/PoseStamped`` of a goal."""
        return goal.pose

    def feedback(self, progress: Progress, place: Any) -> Any:
        """A feedback message; the place is a ``geometry_msgs/PoseStamped``."""
        message = self.kind.Feedback()
        message.current_pose = place
        message.distance_remaining = 0.0 if math.isnan(progress.distance) else progress.distance
        message.navigation_time = Duration(seconds=progress.time).to_msg()
        message.number_of_recoveries = progress.recoveries
        return message

    def result(self, status: Status) -> Any:
        """A result message."""
        message = self.kind.Result()
        # Humble's has neither of the two.
        if hasattr(message, "error_code"):
            codes = {"rejected": UNREACHABLE, "given up": GIVEN_UP}
            message.error_code = codes.get(status.state, 0)
        if hasattr(message, "error_msg"):
            message.error_msg = status.reason
        return message


class NavigateAction:
    """Serves the action; one goal is under way at a time, and a new one takes its place."""

    def __init__(
        self,
        node: Any,
        name: str,
        kind: ActionType,
        *,
        accepts: Callable[[], bool],
        begin: Callable[[Any], None],  # takes a PoseStamped
        cancel: Callable[[], None],
    ) -> None:
        self._kind, self._begin, self._cancel = kind, begin, cancel
        self._handle: Any = None
        self._ended: Any = None
        self._executing = 0
        self._server = ActionServer(
            node,
            kind.kind,
            name,
            lambda handle: None,  # Each goal has its own.
            goal_callback=lambda _: GoalResponse.ACCEPT if accepts() else GoalResponse.REJECT,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )

    @property
    def is_active(self) -> bool:
        """True while a goal of the action is under way."""
        return self._ended is not None

    @property
    def is_open(self) -> bool:
        """True until the client of each goal has its result."""
        return self._executing > 0

    def tell(self, progress: Progress, place: Any) -> None:
        """Publish how far the drive has come, and where the robot is."""
        if self.is_active and self._handle.is_active:
            self._handle.publish_feedback(self._kind.feedback(progress, place))

    def end(self, status: Status) -> None:
        """End the goal of the action, if there is one, by what has become of it."""
        if self._ended is not None:
            ended, self._ended = self._ended, None
            ended.set_result(status)

    def destroy(self) -> None:
        """Take the action off the network."""
        self._server.destroy()

    def _on_accepted(self, handle: Any) -> None:
        # This ends the goal before, as a goal of the topic does.
        self._begin(self._kind.place(handle.request))
        self._handle, self._ended = handle, Future()
        self._executing += 1
        handle.execute(partial(self._execute, self._ended))

    def _on_cancel(self, handle: Any) -> Any:
        if self._ended is not None and handle is self._handle:
            self._cancel()
        return CancelResponse.ACCEPT

    async def _execute(self, ended: Any, handle: Any) -> Any:
        """Wait for the end of the drive; by then a cancel has reached the handle."""
        status = await ended
        # The result is sent in the same step of the executor.
        self._executing -= 1
        if handle.is_cancel_requested:
            handle.canceled()
        elif status.state == "arrived":
            handle.succeed()
        else:
            handle.abort()
        return self._kind.result(status)
