"""Shortest paths of a robot among the obstacles of a world."""
