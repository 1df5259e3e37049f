"""Trials of methods in scenes: run, saved, compared, reported."""
