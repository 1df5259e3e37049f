"""Finite-difference time-domain simulation, tuned to one frequency."""
