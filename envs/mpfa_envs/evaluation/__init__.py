"""Greedy episodes of a policy and their results."""
