"""Predictive control, and the rescue of a policy that stands still; no part knows the world."""
