"""Greedy episodes of a policy, and what they gave."""
