"""Tests of a training run."""
