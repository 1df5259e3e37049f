"""What benchmark_accuracy.py writes: figures as JSON, a plot, and the generated block of benchmarks.md."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path

from generated_block import fill_in, measured, table
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from autdtorch.plot.style import TICK_SIZE, new_figure, readable, styled

DOCUMENT = Path(__file__).parents[1] / "docs" / "benchmarks.md"

Orders = Mapping[str, Mapping[str, float]]

# Okabe-Ito, and a marker each
_LOOKS = {
    "staircase": ("#D55E00", "s"),
    "series bonds": ("#E69F00", "^"),
    "default": ("#0072B2", "o"),
    "extrapolated": ("#009E73", "D"),
}


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes:
        case: its name.
        treatment: of the elements that surfaces cut, or what else tells rows of a case apart.
        spacing: [mm].
        total: relative error of the field.
        scattered: relative error of its scattered part, None if there is none.
        seconds: run time.
        settled: whether all simulations came within the tolerance of the steady state.
    """

    case: str
    treatment: str
    spacing: float
    total: float
    scattered: float | None
    seconds: float
    settled: bool


@dataclass(frozen=True)
class Requirement:
    """A limit of the errors in a case at a spacing [mm], at every treatment whose name begins so."""

    case: str
    treatment: str
    spacing: float
    total: float
    scattered: float | None = None


REQUIREMENTS = (
    Requirement("free space", "default", 1.0, 0.002),
    *(
        Requirement(case, treatment, spacing, total, scattered)
        for case in ("sphere", "rigid sphere")
        for treatment in ("default", "worst")
        for spacing, total, scattered in ((1.0, 0.03, 0.1), (0.5, 0.008, 0.03))
    ),
    Requirement("slab", "default", 1.0, 0.01),
    Requirement("piston", "default", 1.0, 0.01),
)


def write_report(rows: Sequence[Row], orders: Orders, command: str, folder: Path) -> None:
    """Write accuracy.json, accuracy.png and benchmarks.md into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    made = {"command": command, "date": date.today().isoformat(), "cores": os.cpu_count()}
    content = {**made, "rows": [asdict(row) for row in rows], "orders": orders}
    (folder / "accuracy.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    plot_pareto(rows, command).savefig(folder / "accuracy.png")
    parts = (
        measured(command),
        "![Error over run time](accuracy.png)",
        requirements(rows),
        errors(rows),
        slopes(orders),
    )
    fill_in(DOCUMENT, "benchmark_accuracy", parts, folder)


def requirements(rows: Sequence[Row]) -> str:
    """Required and measured errors, as far as measured."""
    lines = []
    for limit in REQUIREMENTS:
        for row in rows:
            wanted = (row.case, row.spacing) == (limit.case, limit.spacing)
            if not wanted or not row.treatment.startswith(limit.treatment):
                continue
            for part, most, found in (
                ("total", limit.total, row.total),
                ("scattered", limit.scattered, row.scattered),
            ):
                if most is not None and found is not None:
                    kept = "yes" if found <= most else "**no**"
                    what = f"{row.case}, {row.treatment}, {row.spacing:g} mm, {part}"
                    lines.append(f"| {what} | at most {percent(most)} | {percent(found)} | {kept} |")
    return "\n".join(("| error | required | measured | kept |", "| --- | --- | --- | --- |", *lines))


def errors(rows: Sequence[Row]) -> str:
    """All measurements."""
    lines = []
    for row in rows:
        scattered = "" if row.scattered is None else percent(row.scattered)
        late = "" if row.settled else ", not settled"
        lines.append(
            [readable(row.case), row.treatment, f"{row.spacing:g} mm", percent(row.total), scattered,
             f"{row.seconds:.3g} s{late}"]
        )  # fmt: skip
    return table(["case", "treatment", "spacing", "total", "scattered", "run time"], lines)


def slopes(orders: Orders) -> str:
    """Observed orders of convergence."""
    names = list(dict.fromkeys(name for found in orders.values() for name in found))
    lines = ["| observed order | " + " | ".join(names) + " |", "| --- |" + " --- |" * len(names)]
    for case, found in orders.items():
        figures = (f"{found[name]:.2f}" if name in found else "" for name in names)
        lines.append(f"| {readable(case)} | " + " | ".join(figures) + " |")
    return "\n".join(lines)


def percent(share: float) -> str:
    """With three digits."""
    return f"{100 * share:.3g} %"


@styled
def plot_pareto(rows: Sequence[Row], command: str) -> Figure:
    """Error of the field over run time, a panel for each case with more than one spacing."""
    cases = [
        case
        for case in dict.fromkeys(row.case for row in rows)
        if len({row.spacing for row in rows if row.case == case}) > 1
    ]
    columns = min(3, len(cases))
    lines = -(-len(cases) // columns)
    figure = new_figure(0.5 + 2.6 * columns, 0.8 + 2.3 * lines)
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for ax, case in zip(panels, cases, strict=False):
        ax.set_title(readable(case), loc="left")
        _draw_case(ax, [row for row in rows if row.case == case])
    for ax in panels[len(cases) :]:
        ax.remove()
    handles = [line for ax in figure.axes for line in ax.lines]
    named = {str(line.get_label()): line for line in handles}
    names = [name for name in _LOOKS if name in named]
    figure.legend([named[name] for name in names], names, loc="outside upper center", ncols=len(names))
    figure.supxlabel(f"run time [s], points at the spacing in mm\n{command}", fontsize=TICK_SIZE)
    figure.supylabel("relative error of the field [%]", fontsize=TICK_SIZE)
    return figure


def _draw_case(ax: Axes, rows: Sequence[Row]) -> None:
    for name, (colour, marker) in _LOOKS.items():
        mine = [row for row in rows if row.treatment == name]
        if not mine:
            continue
        places = [(row.seconds, 100 * row.total) for row in mine]
        if not ax.lines:  # the topmost, where no other line is above
            for row, place in zip(mine, places, strict=True):
                text = f"{row.spacing:g}"
                ax.annotate(text, place, (2, 4), textcoords="offset points", fontsize=TICK_SIZE)
        ax.plot(*zip(*places, strict=True), color=colour, marker=marker, ms=4, lw=1.2, label=name)
    log_axes(ax, (1, 3), (1, 2, 5))
    ax.tick_params(labelsize=TICK_SIZE)
    ax.margins(0.12, 0.15)


def log_axes(ax: Axes, across: Sequence[float], up: Sequence[float]) -> None:
    """Make both axes logarithmic, with plain numbers at these multiples of each power of ten."""
    ax.set(xscale="log", yscale="log")
    for axis, ticks in ((ax.xaxis, across), (ax.yaxis, up)):
        axis.set_major_locator(LogLocator(subs=ticks))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())
