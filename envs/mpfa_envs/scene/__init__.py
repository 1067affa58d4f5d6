"""One moment of an episode as a picture, without a display, or in a live window."""
