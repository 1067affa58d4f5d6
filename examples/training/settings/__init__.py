"""Settings of a training run, what they may be, and how a command line gives them."""
