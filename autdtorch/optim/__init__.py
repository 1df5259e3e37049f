"""Optimisers: they see an objective (drives in, pressure magnitudes out) and nothing behind it."""

METHOD_LABELS = {
    "lssg": "LSSG",
    "bayes_opt": "BO",
    "gabs": "GABS",
    "identify": "identification",
    "gradient_ascent": "gradient",
}
"""Names of the methods, the paper's where it has one, by the names of the functions."""
