"""Optimisers: they see an objective (drives in, pressure magnitudes out) and nothing behind it."""

import re

METHOD_LABELS = {
    "lss": "LSS",
    "lssg": "LSSG",
    "bayes_opt": "BO",
    "gabs": "GABS",
    "identify": "identify",
    "random_search": "random search",
    "gradient_ascent": "gradient ascent",
}
"""Names of the methods, the paper's where it has one, by the names of the functions."""


def label_of(method: str) -> str:
    """A method's name in the paper, or its own, and behind a comma the settings that were swept."""
    name, comma, settings = method.partition(",")
    return METHOD_LABELS.get(name, name.replace("_", " ")) + re.sub(r",(?=\S)", ", ", comma + settings)
