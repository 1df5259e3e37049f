"""Calibration: a simulation is fitted to readings, and says how sure it is."""
