"""Lidar, the map that a robot makes of its scans, and the observation."""
