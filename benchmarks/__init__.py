"""Measurements: the paper's tables, values from frozen buffers, speed against other libraries."""
