"""What benchmark_accuracy.py writes: figures as JSON, a plot, and the generated block of benchmarks.md."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path

from generated_block import fill_in, measured, table
from matplotlib.figure import Figure

from autdtorch.plot import plot_pareto
from autdtorch.plot.style import TICK_SIZE, readable

DOCUMENT = Path(__file__).parents[1] / "docs" / "benchmarks.md"

Orders = Mapping[str, Mapping[str, float]]

DRAWN = ("default", "extrapolated", "staircase", "series bonds")
"""Treatments in the plot."""


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
    figure(rows, command).savefig(folder / "accuracy.png")
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


def figure(rows: Sequence[Row], command: str) -> Figure:
    """Error of the field over run time, a panel for each case with more than one spacing."""
    cases = [
        case
        for case in dict.fromkeys(row.case for row in rows)
        if len({row.spacing for row in rows if row.case == case}) > 1
    ]
    chosen = {
        case: {
            name: found
            for name in DRAWN
            if (found := [row for row in rows if (row.case, row.treatment) == (case, name)])
        }
        for case in cases
    }
    points = {
        case: {name: [(row.seconds, 100 * row.total) for row in mine] for name, mine in by_name.items()}
        for case, by_name in chosen.items()
    }
    spacings = {
        case: {name: [f"{row.spacing:g}" for row in mine] for name, mine in by_name.items()}
        for case, by_name in chosen.items()
    }
    drawn = plot_pareto(points, "run time [s]", "relative error of the field [%]", names=spacings)
    drawn.supxlabel(f"numbers on the front: spacing [mm]\n{command}", fontsize=TICK_SIZE)
    return drawn
