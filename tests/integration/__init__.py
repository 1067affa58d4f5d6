"""Tests of the training application and the scripts."""
