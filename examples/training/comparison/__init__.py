"""Comparisons of many runs: what is asked, as data, and the processes that answer it."""
