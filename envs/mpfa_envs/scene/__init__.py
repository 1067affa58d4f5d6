"""One moment of an episode, drawn without a display or in a live window."""
