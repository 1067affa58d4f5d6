"""Tests of comparisons of many runs."""
