"""The ROS 2 node of a policy: its life cycle, its topics, and messages in and out.

What they mean is in :class:`~mpfa_envs.ros.navigator.Navigator`, and all decisions are in
:class:`~mpfa_envs.ros.controller.Controller`.
"""

from __future__ import annotations

import signal
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from mpfa_envs.checks import check_positive
from mpfa_envs.ros.declared import checked, declare, value_of
from mpfa_envs.ros.frames import Frames
from mpfa_envs.ros.messages import seconds, write_pose, yaw
from mpfa_envs.ros.navigate_action import ActionType, NavigateAction, NavigateToPose
from mpfa_envs.ros.navigator import Navigator
from mpfa_envs.ros.parameters import PARAMETERS, change, check_change, make_controller
from mpfa_envs.ros.status import Status, feedback

if TYPE_CHECKING:
    from collections.abc import Callable

    from mpfa_envs.ros.controller import Order, State

_FEEDBACK: Final = 0.5
"""Time from one feedback to the next [s]."""
_WATCH: Final = 0.1
"""Time from one look at the clock to the next [s]."""
_FROZEN: Final = 0.5
"""Time for which the clock may stand still while the robot drives [s]."""
_ACKNOWLEDGED: Final = 0.5
"""Longest time that the node waits at its end for those who have not yet got its last order [s]."""
_LISTENED: Final = 1.0
"""Time from one look at who takes the orders to the next [s]."""
_LATCHED: Final = {"depth": 1, "durability": DurabilityPolicy.TRANSIENT_LOCAL}


class PolicyNode(LifecycleNode):
    """Subscribes scan, odometry and goal, publishes speeds and what has become of the goal."""

    def __init__(self, action: Callable[[], ActionType] = NavigateToPose) -> None:
        super().__init__("mpfa_policy")
        declare(self, PARAMETERS)
        self._action_type = action
        self.failure: Exception | None = None
        """Why it could not be configured."""
        self.is_driving = False
        """True while the node is active."""
        self.navigator: Navigator | None = None
        """None unless the node is configured."""
        self._action: NavigateAction | None = None
        self._commands: Any = None
        self._undo: list[Callable[[], Any]] = []
        self._goals, self._reason, self._told_at = 0, "", -1.0
        self._lidar, self._unheard, self._listened_at = "", "", -1.0
        self._kind: tuple[Any, ...] = ()
        # A clock of a simulator may stop, and with it all that counts its time.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._ticked, self._ticked_at, self._frozen = 0, 0, ""
        # Also before it is configured: a node that nothing wakes does not hear a signal.
        self.create_timer(_WATCH, self._watch, clock=self._steady)
        self.add_on_set_parameters_callback(self._on_parameters)

    def on_configure(self, state: Any) -> TransitionCallbackReturn:
        """Load the policy and open the topics; it fails if a parameter does not fit."""
        # A node that was shut down closes a moment later.
        self._clean_up()
        try:
            self._configure()
        # Whatever it is: rclpy would hide it.
        except Exception as error:
            self.failure = error
            self.get_logger().error(f"not configured: {error}")
            self._clean_up()
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: Any) -> TransitionCallbackReturn:
        """Take goals from now on."""
        self.is_driving = True
        self._tell()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: Any) -> TransitionCallbackReturn:
        """Give up the goal and stand."""
        self._halt("the node was deactivated")
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: Any) -> TransitionCallbackReturn:
        """Close the topics and forget the policy."""
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: Any) -> TransitionCallbackReturn:
        """Stand, whatever the node does, and close the topics."""
        self._halt("the node was shut down")
        # The client of the action has to hear of its end before.
        closing = self.create_timer(_ACKNOWLEDGED, self._clean_up, clock=self._steady)
        self._undo.append(partial(self.destroy_timer, closing))
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: Any) -> TransitionCallbackReturn:
        """Stand, and be configured again."""
        return self.on_shutdown(state)

    def _value(self, name: str) -> Any:
        return value_of(self, name, PARAMETERS)

    def _configure(self) -> None:
        value = self._value
        controller = make_controller(value)
        timeout = check_positive("transform_timeout", value("transform_timeout"))
        frames = Frames(self._listen(), trust_stamps=value("trust_stamps"))
        self.navigator = Navigator(
            controller,
            frames,
            trust_stamps=value("trust_stamps"),
            turns=value("goal_heading"),
            transform_timeout=timeout,
            base=value("base_frame"),
        )
        self._stamped = value("stamped")
        kind = TwistStamped if self._stamped else Twist
        self._commands = self._publish_on(kind, value("command_topic"), 1)
        self._statuses = self._publish_on(DiagnosticStatus, "~/status", QoSProfile(**_LATCHED))
        self._feedbacks = self._publish_on(Float64MultiArray, "~/feedback", 1)
        self._hear(LaserScan, value("scan_topic"), self._on_scan, qos_profile_sensor_data)
        self._hear(Odometry, value("odometry_topic"), self._on_odometry, qos_profile_sensor_data)
        self._hear(PoseStamped, value("goal_topic"), self._on_goal, 1)
        if topic := value("map_topic"):
            self._hear(OccupancyGrid, topic, self.navigator.know, QoSProfile(**_LATCHED))
        service = self.create_service(Trigger, "~/cancel", self._on_cancel)
        self._undo.append(partial(self.destroy_service, service))
        checks = self.create_timer(1.0 / value("rate"), self._tick)
        self._undo.append(partial(self.destroy_timer, checks))
        self._serve_action()
        if controller.pilot.card.needs_filter and not controller.pilot.has_filter:
            self.get_logger().warning(
                "clearance is 0: the policy learned behind the filter, and touches things without"
            )

    def _publish_on(self, kind: Any, topic: str, quality: Any) -> Any:
        publisher = self.create_publisher(kind, topic, quality)
        self._undo.append(partial(self.destroy_publisher, publisher))
        return publisher

    def _hear(self, kind: Any, topic: str, call: Callable[[Any], None], quality: Any) -> None:
        subscription = self.create_subscription(kind, topic, call, quality)
        self._undo.append(partial(self.destroy_subscription, subscription))

    def _serve_action(self) -> None:
        """Serve the action, where its type is installed."""
        if not (name := self._value("action")):
            return
        try:
            kind = self._action_type()
        except ImportError as error:
            self.get_logger().warning(f"no action is served: {error}")
            return
        self._action = NavigateAction(
            self,
            name,
            kind,
            accepts=lambda: self.is_driving,
            begin=self._on_goal,
            cancel=lambda: self._cancel("canceled"),
        )
        self._undo.append(self._action.destroy)

    def _listen(self) -> Callable[[str, str], Any] | None:
        """The transforms between frames, where tf2 is installed."""
        try:
            from tf2_ros import Buffer, TransformListener
        except ImportError as error:
            self.get_logger().warning(f"no transforms are read, and `mount` counts: {error}")
            return None
        buffer = Buffer()
        # The node would hold on to it.
        self._undo.append(TransformListener(buffer, self).unregister)
        return lambda target, source: buffer.lookup_transform(target, source, Time())

    def _clean_up(self) -> None:
        self.wait_for_listeners()
        while self._undo:
            self._undo.pop()()
        self.navigator = self._action = self._commands = None

    def _now(self) -> float:
        return float(self.get_clock().now().nanoseconds) * 1e-9

    def _on_parameters(self, parameters: Any) -> SetParametersResult:
        try:
            changes = {
                each.name: checked(each.name, each.value, PARAMETERS[each.name])
                for each in parameters
                if each.name in PARAMETERS
            }
            if self.navigator is not None:
                check_change(changes, self.navigator.controller)
                change(changes, self.navigator.controller)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_scan(self, message: Any) -> None:
        if self.navigator is not None:
            try:
                self.navigator.see(message, self._now())
            except ValueError as error:
                # The last scan grows old, which stops the robot.
                self.get_logger().error(f"scan: {error}", throttle_duration_sec=5.0)
            if self.navigator.lidar != self._lidar:
                self._lidar = self.navigator.lidar
                self.get_logger().info(self._lidar)
            self._tick()

    def _on_odometry(self, message: Any) -> None:
        if self.navigator is not None:
            self.navigator.feel(message, self._now())

    def _on_goal(self, message: Any) -> None:
        if self.navigator is None or not self.is_driving:
            self.get_logger().warning("goal ignored: the node is not active")
            return
        self._cancel("another goal has come")
        self._goals += 1
        place = message.pose.position
        pose = place.x, place.y, yaw(message.pose.orientation)
        stamp = seconds(message.header.stamp)
        self.navigator.aim(pose, message.header.frame_id, stamp, self._now())
        self._tick()

    def _on_cancel(self, request: Any, response: Any) -> Any:
        response.success = self.navigator is not None and self.navigator.is_active
        response.message = "canceled" if response.success else "there is no goal"
        self._cancel("canceled")
        return response

    def _cancel(self, reason: str) -> None:
        """Give up the goal, if there is one, and stand."""
        if self.navigator is not None and self.navigator.is_active:
            self.navigator.cancel(reason)
            self._tick()

    def _halt(self, reason: str) -> None:
        """Give up the goal, stand, and take none."""
        try:
            self._cancel(reason)
        finally:
            if self.is_driving:
                self.stop()
            self.is_driving = False

    def _watch(self) -> None:
        """Stop a driving robot where the clock stands still."""
        now, steady = self.get_clock().now().nanoseconds, self._steady.now().nanoseconds
        if now != self._ticked:
            self._ticked, self._ticked_at, self._frozen = now, steady, ""
        elif self.navigator is not None and self.navigator.is_active:
            passed = 1e-9 * (steady - self._ticked_at)
            if passed > _FROZEN:
                self._frozen = f"the clock stands still: for {passed:.1f} s"
                self._order(self.navigator.controller.stand(self._frozen))
                self._tell()

    def _tick(self) -> None:
        if self.navigator is None or not self.is_driving:
            return
        try:
            self._check(self.navigator)
        # Whatever it is: a robot that no one checks must not drive on.
        except Exception as error:
            self.get_logger().error(f"stopped by {error!r}")
            self.navigator.fail()
            self.stop()
            self._tell()

    def _check(self, navigator: Navigator) -> None:
        """Publish what the navigator orders."""
        # Not by the node's clock: one of a simulator does not go on while the node decides.
        began = self._steady.now().nanoseconds
        order = navigator.check(self._now())
        passed = 1e-9 * (self._steady.now().nanoseconds - began)
        if passed > navigator.controller.scan_timeout and navigator.is_active:
            order = navigator.controller.stand(f"too late: the decision took {passed:.1f} s")
        if order is not None:
            self._order(order)
        self._tell()

    def _order(self, order: Order) -> None:
        self._reason = order.reason
        self._publish(order.linear, order.angular)

    def _tell(self) -> None:
        """Publish status and feedback where they have changed or are due."""
        navigator, now = self.navigator, self._now()
        if navigator is None:
            return
        frozen = self._frozen if navigator.is_active else ""
        reason = frozen or navigator.waits or self._reason
        state: State = "waiting" if frozen else navigator.state
        note = self._missing_listener(now) or navigator.controller.note(now)
        status = Status(state, reason, note, self._goals)
        if status.kind != self._kind:
            self._kind = status.kind
            message = status.message(self.get_name())
            self._statuses.publish(message)
            self.get_logger().info(f"{status.state}: {message.message}")
        if self._action is not None and not navigator.is_active:
            self._action.end(status)
        if navigator.is_active and not 0.0 <= now - self._told_at < _FEEDBACK:
            self._told_at = now
            progress = navigator.progress(now)
            self._feedbacks.publish(feedback(progress))
            if self._action is not None:
                self._action.tell(progress, self._place(navigator))

    def _missing_listener(self, now: float) -> str:
        """What is to be said where no one takes the orders; empty if someone does, or must not."""
        if self.navigator is None or not self.navigator.is_active:
            return ""
        if not 0.0 <= now - self._listened_at < _LISTENED:
            topic, self._listened_at = self._commands.topic_name, now
            heard = self.get_subscriptions_info_by_topic(topic)
            kinds = {each.topic_type.rpartition("/")[2] for each in heard}
            mine = TwistStamped if self._stamped else Twist
            self._unheard = ""
            if not kinds:
                self._unheard = f"no one subscribes to {topic}"
            elif mine.__name__ not in kinds:
                other = str(not self._stamped).lower()
                self._unheard = f"{topic} is subscribed as {sorted(kinds)[0]}: set stamped {other}"
        return self._unheard

    def _place(self, navigator: Navigator) -> Any:
        """Where the robot is, as a message."""
        message = PoseStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = navigator.frames.odometry or ""
        if navigator.pose is not None:
            write_pose(message.pose, navigator.pose)
        return message

    def _publish(self, linear: float, angular: float) -> None:
        message = TwistStamped() if self._stamped else Twist()
        twist = message
        if self._stamped:
            message.header.stamp = self.get_clock().now().to_msg()
            message.header.frame_id = self._body_frame()
            twist = message.twist
        twist.linear.x, twist.angular.z = float(linear), float(angular)
        self._commands.publish(message)

    def stop(self) -> None:
        """Have the robot stand still."""
        if self.navigator is not None:
            self._publish(0.0, 0.0)

    def _body_frame(self) -> str:
        """The frame of the robot's body, in which speeds are."""
        return (self.navigator and self.navigator.base_frame) or "base_link"

    def end(self) -> None:
        """Give up the goal, stand, and wait until those who wait for it have heard it."""
        action = self._action
        self._halt("the node has ended")
        until = self._steady.now() + Duration(seconds=_ACKNOWLEDGED)
        while action is not None and action.is_open and self._steady.now() < until:
            rclpy.spin_once(self, timeout_sec=0.02)
        self.wait_for_listeners()

    def wait_for_listeners(self) -> None:
        """Wait until the last order has arrived; it may be lost with its publisher."""
        if self._commands is not None:
            self._commands.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGED))

    def start(self) -> None:
        """Configure and activate the node, as a manager of life cycles does."""
        self.trigger_configure()
        if self.failure is not None:
            raise self.failure
        self.trigger_activate()


def end_on_signals() -> list[int]:
    """Have signals end the program; the list holds those that came."""
    came: list[int] = []

    def end(number: int, _: Any) -> None:
        came.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    hangup = getattr(signal, "SIGHUP", None)
    # A user who ignores the signal wants the node to outlive the terminal.
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:
        signal.signal(hangup, end)
    return came


def main() -> None:
    """Run the node until it is shut down."""
    # The signal handlers of rclpy would end all publishing before the robot is stopped.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    came = end_on_signals()
    node = PolicyNode()
    try:
        if node.get_parameter("autostart").value:
            node.start()
        # The compiler of the loops calls back, and hides what a signal raises then.
        if not came:
            rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        # A second one, as from a terminal and from a launcher, must not come between.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        # If this fails nothing can be published, and the first error must be seen.
        with suppress(Exception):
            node.end()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
