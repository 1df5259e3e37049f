"""Optimisers: they see an objective (drives in, pressure magnitudes out) and nothing behind it."""
