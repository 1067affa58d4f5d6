"""Tests of the navigation task."""
