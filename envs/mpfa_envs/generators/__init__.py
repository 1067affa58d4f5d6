"""Generators of worlds, and worlds by name."""
