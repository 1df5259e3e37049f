"""Devices: what is sent to an array, and what a sensor sends back."""
