"""Messages of ROS as plain values, and back; any object with the same attributes will do."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from mpfa_envs.sensing.scan import Scan
from mpfa_envs.worlds.shapes import OccupancyGrid
from mpfa_envs.worlds.world import World

Pose = tuple[float, float, float]
_OCCUPIED: Final = 65
"""Chance in percent from which a cell is occupied."""


def seconds(stamp: Any) -> float:
    """A ``builtin_interfaces/Time`` [s]."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def yaw(orientation: Any) -> float:
    """Heading of a quaternion [rad]; NaN if it is none."""
    x, y, z, w = (float(getattr(orientation, name)) for name in "xyzw")
    norm = x * x + y * y + z * z + w * w
    if not norm > 0.0:
        return math.nan
    return math.atan2(2.0 * (w * z + x * y) / norm, 1.0 - 2.0 * (y * y + z * z) / norm)


def mount_of(transform: Any) -> tuple[float, float, float, float]:
    """Position, direction of the x axis and roll of a lidar by a ``geometry_msgs/Transform``.

    The roll is 0, or π for one that hangs upside down.
    """
    place, turn = transform.translation, transform.rotation
    x, y, z, w = (float(getattr(turn, name)) for name in "xyzw")
    upright = 2.0 * (x * x + y * y) < x * x + y * y + z * z + w * w
    return float(place.x), float(place.y), yaw(turn), 0.0 if upright else math.pi


def scan_of(message: Any) -> Scan:
    """A ``sensor_msgs/LaserScan``."""
    return Scan(
        message.angle_min,
        message.angle_increment,
        message.ranges,
        message.range_min,
        message.range_max,
        getattr(message, "angle_max", None),
    )


def odometry_of(message: Any) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Pose and speeds of a ``nav_msgs/Odometry``."""
    pose, twist = message.pose.pose, message.twist.twist
    place = pose.position
    return (place.x, place.y, yaw(pose.orientation)), (twist.linear.x, twist.angular.z)


def transformed(pose: Pose, transform: Any) -> Pose:
    """A pose of the source frame in the target frame of a ``geometry_msgs/Transform``."""
    turn, move = yaw(transform.rotation), transform.translation
    cosine, sine = math.cos(turn), math.sin(turn)
    x, y, heading = pose
    return cosine * x - sine * y + move.x, sine * x + cosine * y + move.y, heading + turn


def plan_of(message: Any) -> tuple[World, Pose]:
    """A ``nav_msgs/OccupancyGrid`` as a plan, and the pose of its frame in that of the message.

    Cells of 65 and more are occupied, as for map_server; unknown ones are not.
    """
    info, place = message.info, message.info.origin
    cells = np.array(message.data, dtype=np.int16).reshape(info.height, info.width).T
    grid = OccupancyGrid(np.ascontiguousarray(cells >= _OCCUPIED), float(info.resolution))
    plan = World(name="map", size=grid.size, occupancy=grid)
    return plan, (place.position.x, place.position.y, yaw(place.orientation))


def write_pose(message: Any, pose: tuple[float, float, float]) -> None:
    """Enter (x, y, heading) in a ``geometry_msgs/Pose``."""
    message.position.x, message.position.y = float(pose[0]), float(pose[1])
    message.orientation.z = math.sin(pose[2] / 2.0)
    message.orientation.w = math.cos(pose[2] / 2.0)
