"""A bench for policies on a robot whose orders are late; it shares no code with the simulator."""
