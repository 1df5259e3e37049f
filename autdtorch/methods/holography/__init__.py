"""Holography on known transfer matrices: drives for wanted pressures."""
