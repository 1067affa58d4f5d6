"""One training run: its robots, learner and loop, and what it writes as it goes."""
