"""Measurements: speed against other libraries."""
