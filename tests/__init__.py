"""The tests, a package so that their shared parts are imported by one name."""
