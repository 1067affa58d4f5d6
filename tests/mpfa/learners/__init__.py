"""Tests of torchrl_mpfa/learners."""
