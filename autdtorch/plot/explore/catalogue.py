"""The methods that a live view offers."""

from __future__ import annotations

from autdtorch.methods.base import Method
from autdtorch.methods.catalogue import METHODS, VARIANTS, label_of
from autdtorch.methods.holography.holography import Holography


def offered() -> dict[str, Method]:
    """Return the methods by name; the algorithms of holography are methods of their own."""
    return {name: kind() for name, kind in METHODS.items() if kind is not Holography} | VARIANTS


def choices(methods: dict[str, Method]) -> list[tuple[str, str]]:
    """Return names and labels, those first that need least time."""
    first = ("gradient_ascent", "identify", "gabs")
    return [(name, label_of(name)) for name in sorted(methods, key=lambda name: name not in first)]
