"""Whose examples ``make doctest`` runs: not those of modules that need a ROS 2 installation."""

from __future__ import annotations

from importlib.util import find_spec

if find_spec("rclpy") is None:
    collect_ignore_glob = ["mpfa_envs/ros/*_node.py"]
