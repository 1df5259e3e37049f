"""The methods that a live view offers, with the settings of their configs."""

from __future__ import annotations

from autdtorch.methods.base import Method
from autdtorch.methods.bayes.bayes import BayesOpt
from autdtorch.methods.catalogue import METHODS, label_of
from autdtorch.methods.holography.holography import Holography

OFFERED: dict[str, Method] = {name: kind() for name, kind in METHODS.items() if kind is not Holography} | {
    "bo_foci": BayesOpt(
        evaluations=64, initial=4, model="foci", kernel="phasor", initial_points="sobol", noise="inferred"
    ),
    **{name: Holography(algorithm=name) for name in ("gs", "wgs", "gs_pat", "diff_pat")},
}
"""Methods by name."""


def choices() -> list[tuple[str, str]]:
    """Return names and labels, those first that need least time."""
    first = ("gradient_ascent", "identify", "gabs")
    return [(name, label_of(name)) for name in sorted(OFFERED, key=lambda name: name not in first)]
