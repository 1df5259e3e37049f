"""The methods of this package by name, their variants, and the labels of both in figures and tables."""

from __future__ import annotations

import re
from typing import get_args

from autdtorch.methods.base import Method
from autdtorch.methods.bayes_opt import BayesOpt
from autdtorch.methods.gabs import GABS
from autdtorch.methods.gradient import GradientAscent
from autdtorch.methods.holography.algorithms import Algorithm
from autdtorch.methods.holography.holography import Holography
from autdtorch.methods.identify import Identify
from autdtorch.methods.lssg import LSS, LSSG
from autdtorch.methods.phase_stepping import PhaseStepping
from autdtorch.methods.random_search import RandomSearch

METHODS: dict[str, type[Method]] = {
    method.name: method
    for method in (
        *(LSS, LSSG, BayesOpt, GABS, Identify, PhaseStepping, RandomSearch),
        *(GradientAscent, Holography),
    )
}
"""Methods by name, in the order of reports. Users' methods need no entry: configs name their class."""

VARIANTS: dict[str, Method] = {
    "bo_circle": BayesOpt(kernel="circle"),
    "bo_foci": BayesOpt(evaluations=64, initial=4, model="foci", kernel="phasor", noise="inferred"),
    **{algorithm: Holography(algorithm) for algorithm in get_args(Algorithm)},
}
"""Configs that are settings of a method, by name."""

_LABELS = {
    "bo_foci": "BO per focus",
    "bo_circle": "BO on the circle",
    "naive": "naive (model-based)",
    "gs": "GS (model-based)",
    "wgs": "WGS (model-based)",
    "gs_pat": "GS-PAT (model-based)",
    "diff_pat": "Diff-PAT (model-based)",
}


def label_of(name: str) -> str:
    """Return the label of a method: the paper's, or its name, and after a comma the settings of a sweep."""
    method, comma, settings = name.partition(",")
    label = METHODS[method].label if method in METHODS else _LABELS.get(method, method.replace("_", " "))
    return label + re.sub(r",(?=\S)", ", ", comma + settings)
