"""Rooms and what stands in them: shapes, worlds, and the files that they are read from."""
