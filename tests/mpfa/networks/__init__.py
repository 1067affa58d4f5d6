"""Tests of torchrl_mpfa/networks."""
