"""Look of the Matplotlib figures, and names as readers see them."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import cycle
from typing import Any, NamedTuple, TypeAlias

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from autdtorch.methods.catalogue import label_of as label_of
from autdtorch.utils.arrays import Array
from autdtorch.utils.validation import ArrayLike, invalid, real_tensor, require_kind

ByMethod: TypeAlias = Mapping[str, ArrayLike]
Dashes: TypeAlias = tuple[float, tuple[float, ...]]


class Look(NamedTuple):
    """What tells a method from others: each of the three alone does."""

    colour: str
    marker: str
    dashes: Dashes


# Colours of Okabe and Ito, told apart by colour-blind readers too.
_LOOKS = {
    "lssg": Look("#0072B2", "o", (0, ())),
    "bayes_opt": Look("#D55E00", "s", (0, (5, 1.5))),
    "gabs": Look("#009E73", "D", (0, (5, 1.5, 1, 1.5))),
    "lss": Look("#E69F00", "^", (0, (8, 1.5))),
    "identify": Look("#CC79A7", "v", (0, (1, 1))),
    "random_search": Look("#56B4E9", "X", (0, (3, 1, 1, 1, 1, 1))),
    "gradient_ascent": Look("#000000", "*", (0, (2, 2))),
}
_SPARE_LOOKS = (  # of Tol's muted scheme
    Look("#882255", "P", (0, (6, 2, 2, 2))),
    Look("#999933", "h", (0, (4, 1))),
    Look("#332288", "<", (0, (2, 1, 6, 1))),
    Look("#999999", ">", (0, (3, 3))),
)

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
_MOST_COLUMNS = 3  # of panels
_LETTER = 0.08  # mean width [inch]


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


def new_panels(
    names: Iterable[str], width: float, height: float, xlabel: str, ylabel: str, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """A figure with a panel of that size [inch] for each name, which is its title."""
    titles = [wrapped(readable(name), width) for name in names]
    rows = math.ceil(len(titles) / _MOST_COLUMNS)
    columns = math.ceil(len(titles) / rows)
    figure = new_figure(0.6 + width * columns, 0.8 + height * rows)
    panels = list(figure.subplots(rows, columns, squeeze=False, sharey=sharey).ravel())
    for ax in panels[len(titles) :]:
        ax.remove()
    for index, (ax, title) in enumerate(zip(panels, titles, strict=False)):
        ax.set_title(title)
        ax.set_xlabel(wrapped(xlabel, width))
        ax.tick_params(labelsize=TICK_SIZE)
        if index % columns == 0:
            ax.set_ylabel(wrapped(ylabel, height))
    return figure, panels[: len(titles)]


def add_legend(figure: Figure, handles: Sequence[Artist], title: str | None = None) -> None:
    """A legend above all panels, in as many rows as its entries need."""
    width = sum(0.6 + _LETTER * len(str(handle.get_label())) for handle in handles)
    rows = math.ceil(width / figure.get_figwidth())
    columns = math.ceil(len(handles) / rows)
    figure.legend(handles=handles, title=title, loc="outside upper center", ncols=columns)


def log_axes(ax: Axes, which: str = "xy") -> None:
    """Make axes that are drawn into logarithmic, with plain numbers, as many as there is place for."""
    for name in which:
        axis = {"x": ax.xaxis, "y": ax.yaxis}[name]
        ax.set(**{f"{name}scale": "log"})
        low, high = {"x": ax.get_xlim, "y": ax.get_ylim}[name]()
        decades = math.log10(high / low)
        ticks = (1, 1.5, 2, 3, 5, 7) if decades < 0.7 else (1, 2, 5) if decades < 2 else (1, 3)
        axis.set_major_locator(LogLocator(subs=ticks if decades < 3 else (1,)))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())


def require_scenes(name: str, scenes: Mapping[str, ByMethod]) -> None:
    """Check that there is something to draw.

    Raises:
        ValueError: no scene, or a scene without method.
    """
    accepted = "must have at least one scene, each with at least one method"
    if not isinstance(scenes, Mapping):
        raise invalid(name, scenes, accepted)
    for scene, methods in scenes.items():
        if not isinstance(methods, Mapping):
            raise invalid(f"{name}[{scene!r}]", methods, "must be values by the names of methods")
    if not scenes or not all(scenes.values()):
        raise ValueError(f"{name}: scenes {list(scenes)}; {accepted}")


def require_each(name: str, given: Mapping[str, object], wanted: Collection[str]) -> None:
    """Check that a mapping has an entry for each name of `wanted`.

    Raises:
        ValueError: no mapping, or one without some entry.
    """
    require_kind(name, given, Mapping)
    if missing := [one for one in wanted if one not in given]:
        raise ValueError(f"{name}: none for {missing}; must have one for each of {list(wanted)}")


def numbers(name: str, given: ArrayLike, *axes: str) -> Array:
    """Finite numbers with these axes, of which a figure of a word is the length.

    Raises:
        ValueError: not so, or no number at all.
    """
    values: Array = real_tensor(name, given).detach().cpu().numpy()
    fits = values.ndim == len(axes) and all(
        length == int(axis) for length, axis in zip(values.shape, axes, strict=True) if axis.isdigit()
    )
    if not fits or values.size == 0:
        raise ValueError(f"{name}: shape {values.shape}; must be ({', '.join(axes)}), none of them 0")
    return values


def methods_of(scenes: Iterable[Mapping[str, object]]) -> list[str]:
    """The methods of all scenes, each once, in the order of their first mention."""
    return list(dict.fromkeys(method for by_method in scenes for method in by_method))


def looks_of(names: Iterable[str]) -> dict[str, Look]:
    """A look for each name of a method or series.

    Our methods look the same in every figure. Beside them others take the spare looks in the order of
    `names`; where there is none of ours, they take ours first.
    """
    ours = {label_of(method): look for method, look in _LOOKS.items()}
    names = list(dict.fromkeys(names))
    found = {name: ours[label_of(name)] for name in names if label_of(name) in ours}
    # A figure may leave out the gradient, which is no competitor: that must not change the others' looks.
    beside = any(look is not _LOOKS["gradient_ascent"] for look in found.values())
    free = [*_SPARE_LOOKS, *_LOOKS.values()] if beside else [*_LOOKS.values(), *_SPARE_LOOKS]
    left = cycle(look for look in free if look not in found.values())
    return {name: found[name] if name in found else next(left) for name in names}


def readable(name: str) -> str:
    """The name of a scene or method without underscores."""
    return name.replace("_", " ")


def wrapped(text: str, width: float) -> str:
    """The text in lines of at most that width [inch]."""
    return textwrap.fill(text.replace(",", ", ").replace(",  ", ", "), max(8, int(width / _LETTER)))
