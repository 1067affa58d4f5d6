"""Tests of the reconstructed methods of the paper's table."""
