"""Tests of torchrl_mpfa/storages."""
