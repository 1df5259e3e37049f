"""Objectives: drives in, pressure magnitudes at the control points out."""
