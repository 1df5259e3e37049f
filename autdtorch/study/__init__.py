"""Trials of methods in scenes: run, kept on disk, compared, reported."""
