"""Sensors of the pressure at the control points: microphones, an oscilloscope, a person, a file."""
