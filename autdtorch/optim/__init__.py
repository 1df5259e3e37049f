"""Optimisers: they see an objective (drives in, pressure magnitudes out) and nothing behind it."""

METHOD_LABELS = {
    "lss": "LSS",
    "lssg": "LSSG",
    "bayes_opt": "BO",
    "gabs": "GABS",
    "random_search": "random search",
    "gradient_ascent": "gradient ascent",
}
"""The paper's names of the methods, by the names of the functions."""
