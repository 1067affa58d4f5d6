"""Replay methods on goal tasks of gymnasium-robotics, by ``examples/gymnasium_td3.py``."""
