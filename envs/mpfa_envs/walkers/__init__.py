"""Cylinders that walk about: where they start and how they move."""
