"""Look of the Matplotlib figures, and names as readers see them."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import matplotlib as mpl
from matplotlib.figure import Figure

from autdtorch.optim import label_of as label_of
from autdtorch.validation import ArrayLike

ByMethod: TypeAlias = Mapping[str, ArrayLike]

_STYLE: Any = {  # Any: Matplotlib types every key by itself
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.5,
    "legend.title_fontsize": 8.5,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
styled = mpl.rc_context(_STYLE)
"""Decorator of a function that makes a figure."""

TICK_SIZE = 8.0  # not in the style: ticks are made when the figure is drawn, after the style has gone

_DPI = 150
_SCREEN_DPI = 96  # where a notebook shows it


class ShownFigure(Figure):
    """A figure that Jupyter shows by itself, though pyplot does not know of it."""

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        """PNG, and its width on screen [px]."""
        picture = io.BytesIO()
        self.savefig(picture)
        return picture.getvalue(), {"width": round(_SCREEN_DPI * self.get_figwidth())}


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of that size [inch], which pyplot does not know of."""
    return ShownFigure(figsize=(width, height), dpi=_DPI, layout="constrained")


def require_scenes(name: str, scenes: Mapping[str, ByMethod]) -> None:
    """Check that there is something to draw.

    Raises:
        ValueError: no scene, or a scene without method.
    """
    if not scenes or not all(scenes.values()):
        raise ValueError(
            f"{name}: scenes {list(scenes)}; must have at least one scene, each with at least one method"
        )


def methods_of(scenes: Iterable[ByMethod]) -> list[str]:
    """The methods of all scenes, each once, in the order of their first mention."""
    return list(dict.fromkeys(method for by_method in scenes for method in by_method))


def readable(name: str) -> str:
    """The name of a scene or method without underscores."""
    return name.replace("_", " ")
