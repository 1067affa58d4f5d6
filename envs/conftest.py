"""Whose examples ``make doctest`` runs: not those of modules that need a ROS 2 installation."""

from __future__ import annotations

from importlib.util import find_spec

if find_spec("rclpy") is None:
    names = ("*_node", "navigate_action", "status")
    collect_ignore_glob = [f"mpfa_envs/ros/{name}.py" for name in names]
