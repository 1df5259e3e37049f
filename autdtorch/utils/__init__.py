"""Helpers that know nothing of acoustics: validation, files, memory, threads, progress."""
