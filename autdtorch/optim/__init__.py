"""Optimisers: they see an objective (drives in, pressure magnitudes out) and nothing behind it."""

METHOD_LABELS = {"lssg": "LSSG", "bayes_opt": "BO", "gabs": "GABS", "gradient_ascent": "gradient"}
"""The paper's names of the methods, by the names of the functions."""
