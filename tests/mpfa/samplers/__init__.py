"""Tests of torchrl_mpfa/samplers."""
