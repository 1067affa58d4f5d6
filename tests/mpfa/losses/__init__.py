"""Tests of torchrl_mpfa/losses."""
