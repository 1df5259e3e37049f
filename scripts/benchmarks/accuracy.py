"""Run time against error of transfer matrices: exact solutions, and the paper's cubes.

Writes accuracy.json, accuracy.png and a block of benchmarks.md. Errors are complex relative L2 errors of the
transfer matrix, for the total field and for its scattered part. Run times include the assembly of the scene.
The paper's domain is cut to array, obstacles and first focus; symmetry makes the other three foci equal.
Exits with 1 if an error is above its required limit.

    python scripts/benchmark.py accuracy                     2 to 1 mm
    python scripts/benchmark.py accuracy --fine              with 0.5 mm
    python scripts/benchmark.py accuracy --make-reference    the fine grids of the cubes, once
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from shared import cases
from shared.cases import Case, Simulation, cube_case, error_of, simulate, sphere_case
from shared.document import command_line, fill_in, measured, percent, table
from shared.scenes import relative_error

import autdtorch as at
from autdtorch.plot.costs import plot_pareto
from autdtorch.plot.style import TICK_SIZE, readable

DOCUMENT = "benchmarks.md"

SPACINGS = (2.0, 1.5, 1.0)  # [mm]
FINE_SPACING = 0.5

REFERENCE_SPACINGS = (0.3e-3, 0.2e-3)  # [m]

SHIFTED_SPHERES = ("rigid sphere", "sphere")


@dataclass(frozen=True)
class Row:
    """A measurement.

    Attributes:
        case: name of the case.
        treatment: "default" or what else distinguishes rows of a case.
        spacing: [mm].
        total: relative error of the field.
        scattered: relative error of its scattered part; None if there is none.
        seconds: run time.
        settled: whether all simulations reached the steady state within the tolerance.
    """

    case: str
    treatment: str
    spacing: float
    total: float
    scattered: float | None
    seconds: float
    settled: bool


LIMITS = {
    ("free space", "default", 1.0): (0.002, None),
    **{
        (case, treatment, spacing): limits
        for case in ("sphere", "rigid sphere")
        for treatment in ("default", "worst")
        for spacing, limits in ((1.0, (0.03, 0.1)), (0.5, (0.008, 0.03)))
    },
    ("slab", "default", 1.0): (0.01, None),
    ("piston", "default", 1.0): (0.01, None),
}
"""Largest total and scattered error, by case, first word of the treatment, and spacing [mm]."""

Orders = Mapping[tuple[str, str], float]
"""Observed order of convergence by case and treatment."""


def make_reference() -> None:
    """Store the transfer matrices of the cubes on fine grids."""
    scenes: dict[str, list[dict[str, object]]] = {}
    for name in cases.CUBES:
        scene, matrices = cases.close_scene(name), []
        for spacing in REFERENCE_SPACINGS:
            propagator = at.make_propagator(scene, "box", spacing, tolerance=1e-5, cache=False)
            matrices.append(propagator.transfer_matrix(scene.control_points[:1]))
            print(f"{name} at {spacing * 1e3:.4g} mm done", flush=True)
        print(f"{name}: {relative_error(*matrices):.1e} between the grids", flush=True)
        scenes[name] = [
            {"spacing": h, "real": g.real.tolist(), "imag": g.imag.tolist()}
            for h, g in zip(REFERENCE_SPACINGS, matrices, strict=True)
        ]
    cases.CUBE_MATRICES.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"command": command_line(), "scenes": scenes}, indent=1)
    cases.CUBE_MATRICES.write_text(text + "\n", "utf-8")


def compare(case: Case, treatment: str, spacing: float, found: Simulation) -> Row:
    """Return the errors of a transfer matrix."""
    total, scattered = error_of(case, found.matrix)
    print(f"{case.name}, {treatment}, {spacing:g} mm: {percent(total)}, {found.seconds:.1f} s", flush=True)
    return Row(case.name, treatment, spacing, total, scattered, found.seconds, found.settled)


def worst_shift(name: str, spacing: float, count: int) -> Row:
    """Return the row with the largest total error of `count` random positions of a sphere on the grid."""
    # Equal for every sphere and, in cells, for every spacing [mm].
    shifts = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) * spacing * 1e-3
    rows = []
    for shift in shifts.tolist():
        case = sphere_case(name, shift)
        rows.append(compare(case, f"worst of {count} shifts", spacing, simulate(case, spacing)))
    return max(rows, key=lambda one: one.total)


def worst_point(spacing: float = 1.0) -> Row:
    """Return the error of the piston's worst direction, relative to the pressure there."""
    case = cases.piston_case()
    found = simulate(case, spacing)
    worst = cases.worst_point_error(case, found.matrix)
    return Row(case.name, "default, worst point", spacing, worst, None, found.seconds, found.settled)


def measure(spacings: Sequence[float], shifts: int) -> list[Row]:
    """Measure every case."""
    simulate(sphere_case("sphere"), 2.8)  # compiles the kernel
    swept = [cases.free_space_case(), *map(sphere_case, cases.SPHERES)]
    if cases.CUBE_MATRICES.exists():
        swept += map(cube_case, cases.CUBES)
    else:
        print("the cubes are left out: they need --make-reference once", flush=True)
    rows = [compare(case, "default", h, simulate(case, h)) for case in swept for h in spacings]
    if shifts:
        rows += [worst_shift(name, h, shifts) for name in SHIFTED_SPHERES for h in spacings]
    for case in (cases.slab_case(), cases.wall_case()):
        rows.append(compare(case, "default", 1.0, simulate(case, 1.0)))
    return [*rows, worst_point()]


def observed_order(spacings: Sequence[float], errors: Sequence[float]) -> float:
    """Return the least-squares slope of log error over log spacing."""
    return float(np.polyfit(np.log(spacings), np.log(errors), 1)[0])


def series(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    """Return the rows by case and treatment."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.case, row.treatment), []).append(row)
    return found


def orders(rows: Sequence[Row]) -> Orders:
    """Return the observed order of each series with more than one spacing."""
    return {
        key: observed_order([one.spacing for one in mine], [one.total for one in mine])
        for key, mine in series(rows).items()
        if len(mine) > 1
    }


def exceeded(rows: Sequence[Row]) -> tuple[int, list[str]]:
    """Return the number of limits that apply to the rows, and a line for each exceeded one."""
    count, lines = 0, []
    for row in rows:
        key = (row.case, row.treatment.split()[0].rstrip(","), row.spacing)
        found = (("total", row.total), ("scattered", row.scattered))
        for (part, error), most in zip(found, LIMITS.get(key, (None, None)), strict=True):
            if most is not None and error is not None:
                count += 1
                if not error <= most:
                    what = f"{row.case}, {row.treatment}, {row.spacing:g} mm, {part}"
                    lines.append(f"{what}: {percent(error)}, required at most {percent(most)}")
    return count, lines


def errors(rows: Sequence[Row]) -> str:
    """Return a table with a row for each case and treatment."""
    spacings = sorted({row.spacing for row in rows}, reverse=True)
    cases = list(dict.fromkeys(row.case for row in rows))
    found, by_series, lines = orders(rows), series(rows), []
    for case, treatment in sorted(by_series, key=lambda one: cases.index(one[0])):
        at_spacing = {row.spacing: row for row in by_series[case, treatment]}
        total = [percent(at_spacing[h].total) if h in at_spacing else "" for h in spacings]
        one = at_spacing.get(1.0)
        scattered = "" if one is None or one.scattered is None else percent(one.scattered)
        seconds = "" if one is None else f"{one.seconds:.3g} s{'' if one.settled else ', not settled'}"
        order = f"{found[case, treatment]:.2f}" if (case, treatment) in found else ""
        lines.append([readable(case), treatment, *total, scattered, seconds, order])
    header = [*(f"{h:g} mm" for h in spacings), "scattered, 1 mm", "time, 1 mm", "order"]
    return table(["case", "treatment", *header], lines)


def figure(rows: Sequence[Row]) -> Figure:
    """Plot the error of the field over the run time, a panel for each case with more than one spacing."""
    swept = {case: mine for (case, name), mine in series(rows).items() if name == "default" and len(mine) > 1}
    plotted = plot_pareto(
        {
            readable(case): {"autdtorch": [(r.seconds, 100 * r.total) for r in mine]}
            for case, mine in swept.items()
        },
        "run time [s]",
        "relative error of the field [%]",
        names={
            readable(case): {"autdtorch": [f"{r.spacing:g}" for r in mine]} for case, mine in swept.items()
        },
    )
    plotted.supxlabel(f"numbers on the front: spacing [mm]\n{command_line()}", fontsize=TICK_SIZE)
    return plotted


def write_report(rows: Sequence[Row], folder: Path) -> list[str]:
    """Write accuracy.json, accuracy.png and benchmarks.md into `folder`; return the exceeded limits."""
    count, failed = exceeded(rows)
    limits = "\n".join(failed) if failed else f"All {count} required limits are kept."
    legend = "Total error by spacing; scattered error and run time at 1 mm; observed order."
    parts = (measured(), "![Error over run time](accuracy.png)", f"{legend} {limits}", errors(rows))
    fill_in(DOCUMENT, "benchmark.py accuracy", parts, folder)
    made = {"command": command_line(), "date": date.today().isoformat(), "cores": os.cpu_count()}
    content = json.dumps({**made, "rows": [asdict(row) for row in rows]}, indent=1)
    (folder / "accuracy.json").write_text(content + "\n", encoding="utf-8")
    figure(rows).savefig(folder / "accuracy.png")
    return failed


OPTIONS = {
    "--spacings": {"type": float, "nargs": "+", "default": SPACINGS, "metavar": "MM", "help": "two or more"},
    "--fine": {"action": "store_true", "help": "also 0.5 mm"},
    "--shifts": {"type": int, "default": 5, "help": "positions of the sphere on the grid"},
    "--make-reference": {"action": "store_true", "help": "only that"},
}


def main(given: argparse.Namespace) -> int:
    """Measure, or make the reference."""
    if given.make_reference:
        make_reference()
        return 0
    spacings = sorted({*given.spacings, *([FINE_SPACING] if given.fine else [])}, reverse=True)
    if len(spacings) < 2:
        raise SystemExit(f"argument --spacings: {given.spacings}; must be at least two different ones")
    failed = write_report(measure(spacings, given.shifts), given.output)
    print(*failed, sep="\n")
    return int(bool(failed))
