"""Measurements: speed against other libraries, and the study of when prioritized replay helps."""
