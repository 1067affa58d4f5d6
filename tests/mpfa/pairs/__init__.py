"""Every part beside every other: what a buffer does on all paths, compared with a twin."""
