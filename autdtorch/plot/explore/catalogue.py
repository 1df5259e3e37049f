"""The methods that a live view offers, with the settings of their configs."""

from __future__ import annotations

from typing import get_args

from autdtorch.methods.base import Method
from autdtorch.methods.bayes.bayes import BayesOpt
from autdtorch.methods.catalogue import METHODS, label_of
from autdtorch.methods.holography.holography import Algorithm, Holography


def offered() -> dict[str, Method]:
    """Return the methods by name."""
    own: dict[str, Method] = {
        "bayes_opt": BayesOpt(),
        "bo_circle": BayesOpt(kernel="circle"),
        "bo_foci": BayesOpt(evaluations=64, initial=4, model="foci", kernel="phasor", noise="inferred"),
    }
    others = {name: kind() for name, kind in METHODS.items() if kind not in (BayesOpt, Holography)}
    return others | own | {name: Holography(algorithm=name) for name in get_args(Algorithm)}


def choices(methods: dict[str, Method]) -> list[tuple[str, str]]:
    """Return names and labels, those first that need least time."""
    first = ("gradient_ascent", "identify", "gabs")
    return [(name, label_of(name)) for name in sorted(methods, key=lambda name: name not in first)]
