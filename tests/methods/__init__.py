"""Tests of the replay methods."""
