"""As much of rclpy and tf2 as the policy's node needs, where ROS is not installed."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest


class World:
    """What the fakes share: the clock, the transform, and all that was sent and logged."""

    def __init__(self) -> None:
        self.now = 10.0
        self.transform: Any = None
        self.parameters: dict[str, Any] = {}
        self.sent: list[tuple[float, float]] = []
        self.logged: list[tuple[str, str]] = []
        self.spin: Any = lambda node: None
        self.broken = False

    def publish(self, message: Any) -> None:
        if self.broken:
            raise RuntimeError("the publisher is broken")
        self.sent.append((message.linear.x, message.angular.z))

    def lookup(self, *_: Any) -> Any:
        if self.transform is None:
            raise RuntimeError("no such transform")
        return self.transform

    def log(self, level: str, text: str, **_: Any) -> None:
        self.logged.append((level, text))


class _Twist:
    def __init__(self) -> None:
        self.linear, self.angular = SimpleNamespace(x=0.0), SimpleNamespace(z=0.0)


def _node(world: World) -> type:
    """The class of nodes."""

    class Node:
        def __init__(self, name: str) -> None:
            self._values: dict[str, Any] = {}

        def declare_parameter(self, name: str, default: Any) -> None:
            self._values[name] = world.parameters.get(name, default)

        def get_parameter(self, name: str) -> Any:
            return SimpleNamespace(value=self._values[name])

        def create_publisher(self, *_: Any) -> Any:
            return SimpleNamespace(publish=world.publish)

        def get_clock(self) -> Any:
            return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=round(world.now * 1e9)))

        def get_logger(self) -> Any:
            def level(name: str) -> Any:
                return lambda text, **options: world.log(name, text, **options)

            return SimpleNamespace(
                info=level("info"), warning=level("warning"), error=level("error")
            )

        def create_subscription(self, *_: Any, **__: Any) -> None: ...

        def create_timer(self, *_: Any) -> None: ...

        def destroy_node(self) -> None: ...

    return Node


def install(patch: pytest.MonkeyPatch, world: World) -> Any:
    """Put the fakes in the place of rclpy, and import the node's module again."""

    def module(name: str, **values: Any) -> None:
        made = ModuleType(name)
        made.__dict__.update(values)
        patch.setitem(sys.modules, name, made)

    module(
        "rclpy",
        init=lambda **_: None,
        spin=lambda node: world.spin(node),
        try_shutdown=lambda: None,
    )
    module("rclpy.node", Node=_node(world))
    durability = SimpleNamespace(TRANSIENT_LOCAL=1)
    qos = {"DurabilityPolicy": durability, "QoSProfile": SimpleNamespace}
    module("rclpy.qos", qos_profile_sensor_data=None, **qos)
    module("rclpy.signals", SignalHandlerOptions=SimpleNamespace(NO=0))
    module("rclpy.time", Time=lambda: None)
    for package, names in {
        "geometry_msgs": ("PoseStamped", "TwistStamped"),
        "nav_msgs": ("OccupancyGrid", "Odometry"),
        "sensor_msgs": ("LaserScan",),
    }.items():
        module(package)
        module(f"{package}.msg", Twist=_Twist, **dict.fromkeys(names))
    buffer = SimpleNamespace(lookup_transform=world.lookup)
    module("tf2_ros", Buffer=lambda: buffer, TransformListener=lambda *_: None)
    patch.delitem(sys.modules, "mpfa_envs.ros.policy_node", raising=False)
    found = importlib.import_module("mpfa_envs.ros.policy_node")
    patch.delitem(sys.modules, "mpfa_envs.ros.policy_node")
    return found
