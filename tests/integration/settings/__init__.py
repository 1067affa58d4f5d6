"""Tests of settings, and of the environments that follow from them."""
