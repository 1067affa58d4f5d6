"""Tests of the replay parts."""
