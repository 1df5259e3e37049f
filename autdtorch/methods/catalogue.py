"""The methods of this package by name, and the labels of methods in figures and tables."""

from __future__ import annotations

import re

from autdtorch.methods.base import Method
from autdtorch.methods.bayes.bayes import BayesOpt
from autdtorch.methods.gabs import GABS
from autdtorch.methods.gradient import GradientAscent
from autdtorch.methods.holography.holography import Holography
from autdtorch.methods.identify import Identify
from autdtorch.methods.lssg import LSS, LSSG
from autdtorch.methods.random_search import RandomSearch

METHODS: dict[str, type[Method]] = {
    method.name: method
    for method in (LSS, LSSG, BayesOpt, GABS, Identify, RandomSearch, GradientAscent, Holography)
}
"""Methods by name, in the order of reports. A method of one's own needs no entry: configs name its class."""

_VARIANTS = {
    "bo_foci": "BO per focus",
    "bo_circle": "BO on the circle",
    "naive": "naive (model-based)",
    "gs": "GS (model-based)",
    "wgs": "WGS (model-based)",
    "gs_pat": "GS-PAT (model-based)",
    "diff_pat": "Diff-PAT (model-based)",
}
"""Labels of configs that are settings of a method."""


def label_of(name: str) -> str:
    """Return the label of a method: the paper's, or its name, and after a comma the settings of a sweep."""
    method, comma, settings = name.partition(",")
    label = METHODS[method].label if method in METHODS else _VARIANTS.get(method, method.replace("_", " "))
    return label + re.sub(r",(?=\S)", ", ", comma + settings)
