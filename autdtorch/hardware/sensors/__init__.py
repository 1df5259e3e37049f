"""Sensors of the pressure at the control points: an oscilloscope, a person, a file."""
