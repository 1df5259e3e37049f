"""Helpers without acoustics: validation, files, memory, threads, progress."""
