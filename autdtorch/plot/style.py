"""Style of the Matplotlib figures: looks of methods, figures and panels, legends, axes, names."""

from __future__ import annotations

import io
import math
import os
import textwrap
from collections.abc import Callable, Iterable, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis, YAxis
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter, StrMethodFormatter

from autdtorch.methods.catalogue import label_of as label_of
from autdtorch.utils.files import in_folder


class Look(NamedTuple):
    """Colour, marker and dashes of a method. Each differs from those of all other methods."""

    colour: str
    marker: str
    dashes: tuple[float, tuple[float, ...]]


_LOOKS = {  # colours of Okabe and Ito
    "lssg": Look("#0072B2", "o", (0, ())),
    "bayes_opt": Look("#D55E00", "s", (0, (5, 1.5))),
    "bo_foci": Look("#882255", "P", (0, (6, 2, 2, 2))),
    "gabs": Look("#009E73", "D", (0, (5, 1.5, 1, 1.5))),
    "lss": Look("#E69F00", "^", (0, (8, 1.5))),
    "identify": Look("#CC79A7", "v", (0, (1, 1))),
    "random_search": Look("#56B4E9", "X", (0, (3, 1, 1, 1, 1, 1))),
    "phase_stepping": Look("#332288", "<", (0, (2, 1, 6, 1))),
    "gradient_ascent": Look("#000000", "*", (0, (2, 2))),
}
_SPARE_LOOKS = (  # colours of Tol's muted scheme
    Look("#44AA99", "p", (0, (1, 3))),
    Look("#999933", "h", (0, (4, 1))),
    Look("#661100", "8", (0, (8, 2, 2, 2))),
    Look("#999999", ">", (0, (3, 3))),
)

TITLE_SIZE = 9.0
_STYLE: Any = {  # Any: Matplotlib types every key by itself
    "font.size": 9.0,
    "axes.titlesize": TITLE_SIZE,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.5,
    "legend.title_fontsize": 8.5,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
styled = mpl.rc_context(_STYLE)  # decorator for functions that make a figure
TICK_SIZE = 8.0  # not in the style, which is no longer set when the figure is drawn and its ticks are made

_DPI = 150
_SCREEN_DPI = 96  # in a notebook
_MOST_COLUMNS = 3  # panels side by side
_LETTER = 0.08  # mean width of a letter [inch]
_MARGIN = 0.1  # beside a legend [inch]
_HANDLE = 4.8  # width of a legend entry without its text, in letters: handle, space before and after the text
_TICKS = 6  # most intervals on an axis
_LINE = 0.18  # distance of tick labels above each other [inch]
_GAP = 0.1  # between tick labels side by side [inch]


class ShownFigure(Figure):
    """A figure that Jupyter displays without pyplot."""

    def savefig(self, fname: Any, **kwargs: Any) -> None:
        """Save the figure as Matplotlib does; make a missing folder."""
        super().savefig(in_folder(Path(fname)) if isinstance(fname, str | os.PathLike) else fname, **kwargs)

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        picture = io.BytesIO()
        self.savefig(picture)
        return picture.getvalue(), {"width": round(_SCREEN_DPI * self.get_figwidth())}


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size [inch], not registered with pyplot."""
    return ShownFigure(figsize=(width, height), dpi=_DPI, layout="constrained")


def new_panels(
    names: Iterable[str], width: float, height: float, xlabel: str, ylabel: str, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel of a size [inch] for each name, which is its title."""
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
    """Add a legend above all panels, in as few rows as its width allows; the figure grows by further rows."""
    size, room = _STYLE["legend.fontsize"], figure.get_figwidth() - 2 * _MARGIN
    widths = []
    for handle in handles:
        handle.set_label(wrapped(str(handle.get_label()), room - _HANDLE * size / 72))
        lines = str(handle.get_label()).splitlines()
        widths.append(_HANDLE * size / 72 + max(text_width(line, size) for line in lines))
    columns = len(handles)
    while columns > 1 and sum(max(column) for column in np.array_split(widths, columns)) > room:
        columns -= 1
    columns = math.ceil(len(handles) / math.ceil(len(handles) / columns))  # rows of equal length
    longest = max(str(handle.get_label()).count("\n") + 1 for handle in handles)
    further = longest * math.ceil(len(handles) / columns) - 1
    figure.set_figheight(figure.get_figheight() + 1.3 * further * size / 72)
    figure.legend(handles=handles, title=title, loc="outside upper center", ncols=columns)


def text_width(text: str, size: float) -> float:
    """Return the width [inch] of a line of text in letters of a size [points]."""
    width, _, _ = text_to_path.get_text_width_height_descent(text, FontProperties(size=size), ismath=False)
    return float(width) / 72


def set_ticks(axis: Axis, length: float, limits: tuple[float, float], unit: float = 1.0) -> None:
    """Set ticks at round numbers of a unit, whose labels do not overlap.

    Args:
        axis: a linear axis.
        length: of the axis [inch].
        limits: ends of the axis, in the units of its data.
        unit: of the labels, in the units of the data.
    """
    low, high = sorted(limit / unit for limit in limits)

    def fits(text: str, intervals: float) -> bool:
        needed = _LINE if isinstance(axis, YAxis) else text_width(text, TICK_SIZE) + _GAP
        return length / intervals >= needed

    places, decimals = round_numbers(low, high, fits)
    axis.set_major_locator(FixedLocator([unit * place for place in places]))
    axis.set_major_formatter(lambda value, _: f"{value / unit:.{decimals}f}".replace("-", "\N{MINUS SIGN}"))


def round_numbers(low: float, high: float, fits: Callable[[str, float], bool]) -> tuple[list[float], int]:
    """Return round numbers from `low` to `high`, and their decimals, for labels that do not overlap.

    Args:
        low: lower end of the axis.
        high: upper end of the axis.
        fits: whether a label has room if the axis is divided into a number of intervals.
    """
    decade = 10.0 ** math.floor(math.log10((high - low) / _TICKS))
    places, decimals = list[float](), 0
    for step in (decade * digit for digit in (1, 2, 5, 10, 20, 50, 100)):
        counts = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
        if not counts:
            break
        places, decimals = [step * count for count in counts], max(0, -math.floor(math.log10(step) + 1e-9))
        longest = max((f"{place:.{decimals}f}" for place in places), key=len)
        intervals = (high - low) / step
        if intervals <= _TICKS and fits(longest, intervals):
            return places, decimals
    return places[len(places) // 2 :][:1], decimals


def begin_at_zero(ax: Axes) -> None:
    """Extend the vertical axis of what is drawn to 0, with the usual room above equal values too."""
    ax.update_datalim([(0.0, 0.0)], updatex=False)
    ax.autoscale_view(scalex=False)
    if all(each.dataLim.y0 >= 0 for each in ax.get_shared_y_axes().get_siblings(ax)):
        ax.set_ylim(bottom=0.0)


def log_axes(ax: Axes, which: str = "xy") -> None:
    """Make axes with data logarithmic, with plain numbers at ticks that do not overlap."""
    for name in which:
        axis = {"x": ax.xaxis, "y": ax.yaxis}[name]
        ax.set(**{f"{name}scale": "log"})
        low, high = {"x": ax.get_xlim, "y": ax.get_ylim}[name]()
        decades = math.log10(high / low)
        ticks = (1, 1.5, 2, 3, 5, 7) if decades < 0.7 else (1, 2, 5) if decades < 2 else (1, 3)
        axis.set_major_locator(LogLocator(subs=ticks if decades < 3 else (1,)))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())


def looks_of(names: Iterable[str]) -> dict[str, Look]:
    """Return a look for each name of a method or series.

    The methods of autdtorch look alike in every figure. Other names take spare looks in the order of `names`;
    in a figure without methods of autdtorch, they take the looks of these first.
    """
    ours = {label_of(method): look for method, look in _LOOKS.items()}
    names = list(dict.fromkeys(names))
    looks = {name: ours[label_of(name)] for name in names if label_of(name) in ours}
    # Whether a figure has the gradient, a baseline, does not change the looks of others.
    beside = any(look is not _LOOKS["gradient_ascent"] for look in looks.values())
    free = [*_SPARE_LOOKS, *_LOOKS.values()] if beside else [*_LOOKS.values(), *_SPARE_LOOKS]
    spare = cycle(look for look in free if look not in looks.values())
    return {name: looks[name] if name in looks else next(spare) for name in names}


def readable(name: str) -> str:
    """Return the name of a scene or method without underscores."""
    return name.replace("_", " ")


def wrapped(text: str, width: float, most: int | None = None) -> str:
    """Return the text in lines of at most a width [inch]; beyond `most` lines an ellipsis ends it."""
    spaced, letters = text.replace(",", ", ").replace(",  ", ", "), max(8, int(width / _LETTER))
    ellipsis = "\N{HORIZONTAL ELLIPSIS}"
    return textwrap.fill(spaced, letters, max_lines=most, placeholder=ellipsis, break_on_hyphens=False)
