"""Run time against error of transfer matrices: exact solutions, and the paper's cubes.

Writes accuracy.png and a block of the documentation. Errors are complex relative L2 errors of
the transfer matrix, for the total field and for its scattered part. Run times include the assembly of the
scene. The paper's domain is cut to array, obstacles and first focus; symmetry makes the other three foci
equal. Exits with 1 if an error is above its required limit.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from matplotlib.figure import Figure
from shared import cases
from shared.cases import Case, SimulatedCase, cube_case, error_of, simulate, sphere_case
from shared.document import Page, command_line, percent, table
from shared.scenes import relative_error, uncached

from autdtorch.plot.cost_figures import plot_pareto
from autdtorch.plot.style import TICK_SIZE, readable

DOCUMENT = "benchmarks.md"

SPACINGS = (2.0, 1.5, 1.0)  # [mm]
FINE_SPACING = 0.5  # [mm]
REFERENCE_SPACINGS = (0.3, 0.2)  # [mm]
SHIFTED_SPHERES = ("rigid sphere", "sphere")

OPTIONS = {
    "--spacings": {"type": float, "nargs": "+", "default": SPACINGS, "metavar": "MM", "help": "two or more"},
    "--fine": {"action": "store_true", "help": "also 0.5 mm"},
    "--shifts": {"type": int, "default": 5, "help": "positions of the sphere on the grid"},
    "--make-reference": {"action": "store_true", "help": "only simulate the cubes on the fine grids"},
}


@dataclass(frozen=True)
class Row:
    """A measurement of a case; relative errors of the field and of its scattered part."""

    case: str
    treatment: str  # "default" or what else distinguishes rows of a case
    spacing: float  # [mm]
    total: float
    scattered: float | None  # None without obstacles
    seconds: float
    settled: bool  # whether all simulations reached the steady state within the tolerance


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


def main(page: Page, spacings: Sequence[float], fine: bool, shifts: int, make_reference: bool) -> int:
    if make_reference:
        store_reference()
        return 0
    spacings = sorted({*spacings, *([FINE_SPACING] if fine else [])}, reverse=True)
    if len(spacings) < 2:
        raise SystemExit(f"argument --spacings: {spacings}; must be at least two different ones")
    failed = write_report(measure(spacings, shifts), page)
    print(*failed, sep="\n")
    return int(bool(failed))


def store_reference() -> None:
    """Store the transfer matrices of the cubes on fine grids."""
    scenes: dict[str, list[dict[str, object]]] = {}
    for name in cases.CUBES:
        scene = cases.close_scene(name)
        matrices = [uncached(scene, "box", h, 1e-5).transfer_matrix() for h in REFERENCE_SPACINGS]
        print(f"{name}: {relative_error(*matrices):.1e} between the grids", flush=True)
        scenes[name] = [
            {"spacing": 1e-3 * h, "real": matrix.real.tolist(), "imag": matrix.imag.tolist()}
            for h, matrix in zip(REFERENCE_SPACINGS, matrices, strict=True)
        ]
    text = json.dumps({"command": command_line(), "scenes": scenes}, indent=1)
    cases.CUBE_MATRICES.write_text(text + "\n", "utf-8")


def measure(spacings: Sequence[float], shifts: int) -> list[Row]:
    simulate(sphere_case("sphere"), 2.8)  # compiles the kernel
    swept = [cases.free_space_case(), *map(sphere_case, cases.SPHERES), *map(cube_case, cases.CUBES)]
    rows = [compare(case, "default", h, simulate(case, h)) for case in swept for h in spacings]
    if shifts:
        rows += [worst_shift(name, h, shifts) for name in SHIFTED_SPHERES for h in spacings]
    for case in (cases.slab_case(), cases.wall_case()):
        rows.append(compare(case, "default", 1.0, simulate(case, 1.0)))
    return [*rows, worst_point()]


def compare(case: Case, treatment: str, spacing: float, simulation: SimulatedCase) -> Row:
    total, scattered = error_of(case, simulation.matrix)
    seconds = f"{simulation.seconds:.1f} s"
    print(f"{case.name}, {treatment}, {spacing:g} mm: {percent(total)}, {seconds}", flush=True)
    return Row(case.name, treatment, spacing, total, scattered, simulation.seconds, simulation.settled)


def worst_shift(name: str, spacing: float, count: int) -> Row:
    """Return the row with the largest total error of `count` random positions of a sphere on the grid."""
    # Equal for every sphere and, in cells, for every spacing [mm].
    shifts = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) * spacing * 1e-3
    rows = []
    for shift in shifts.tolist():
        case = sphere_case(name, shift)
        rows.append(compare(case, f"worst of {count} shifts", spacing, simulate(case, spacing)))
    return max(rows, key=lambda row: row.total)


def worst_point(spacing: float = 1.0) -> Row:
    """Return the error of the piston's worst direction, relative to the pressure there."""
    case = cases.piston_case()
    done = simulate(case, spacing)
    worst = float(((done.matrix - case.exact).abs() / case.exact.abs()).max())
    return Row(case.name, "default, worst point", spacing, worst, None, done.seconds, done.settled)


def series(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    """Return the rows by case and treatment, all treatments of a case in a row."""
    cases = list(dict.fromkeys(row.case for row in rows))
    ordered = sorted(rows, key=lambda row: (cases.index(row.case), row.treatment))
    return {key: list(group) for key, group in groupby(ordered, lambda row: (row.case, row.treatment))}


def observed_order(spacings: Sequence[float], errors: Sequence[float]) -> float:
    """Return the least-squares slope of log error over log spacing."""
    return float(np.polyfit(np.log(spacings), np.log(errors), 1)[0])


def exceeded(rows: Sequence[Row]) -> tuple[int, list[str]]:
    """Return the number of limits that apply to the rows, and a line for each exceeded one."""
    count, lines = 0, []
    for row in rows:
        limits = LIMITS.get((row.case, row.treatment.split()[0].rstrip(","), row.spacing), (None, None))
        for part, limit in zip(("total", "scattered"), limits, strict=True):
            error = getattr(row, part)
            if limit is None or error is None:
                continue
            count += 1
            if not error <= limit:
                what = f"{row.case}, {row.treatment}, {row.spacing:g} mm, {part}"
                lines.append(f"{what}: {percent(error)}, required at most {percent(limit)}")
    return count, lines


def error_table(rows: Sequence[Row]) -> str:
    """Return a table with a row for each case; limits alone judge shifted spheres."""
    spacings = sorted({row.spacing for row in rows}, reverse=True)
    lines = []
    for (case, treatment), group in series(rows).items():
        if treatment.startswith("worst"):
            continue
        by_spacing = {row.spacing: row for row in group}
        total = [percent(by_spacing[h].total) if h in by_spacing else "" for h in spacings]
        row = by_spacing.get(1.0)
        scattered = "" if row is None or row.scattered is None else percent(row.scattered)
        seconds = "" if row is None else f"{row.seconds:.3g} s{'' if row.settled else ', not settled'}"
        order = observed_order(list(by_spacing), [row.total for row in group]) if len(group) > 1 else None
        cells = [*total, scattered, seconds, "" if order is None else f"{order:.2f}"]
        lines.append([readable(case), *cells])
    header = [*(f"{h:g} mm" for h in spacings), "scattered, 1 mm", "time, 1 mm", "order"]
    return table(["case", *header], lines)


def figure(rows: Sequence[Row]) -> Figure:
    """Plot the error of the field over the run time, a panel for each case with more than one spacing."""
    groups = ((case, group) for (case, name), group in series(rows).items() if name == "default")
    swept = {readable(case): group for case, group in groups if len(group) > 1}
    plotted = plot_pareto(
        {case: {"autdtorch": [(r.seconds, 100 * r.total) for r in group]} for case, group in swept.items()},
        "run time [s]",
        "relative error of the field [%]",
        names={case: {"autdtorch": [f"{r.spacing:g}" for r in group]} for case, group in swept.items()},
    )
    plotted.supxlabel(f"numbers on the front: spacing [mm]\n{command_line()}", fontsize=TICK_SIZE)
    return plotted


def write_report(rows: Sequence[Row], page: Page) -> list[str]:
    """Write the block and accuracy.png; return the exceeded limits."""
    count, failed = exceeded(rows)
    limits = "\n".join(failed) if failed else f"All {count} required limits hold."
    legend = "Total error by spacing; scattered error and run time at 1 mm; observed order."
    page.write("![Error over run time](accuracy.png)", f"{legend} {limits}", error_table(rows))
    page.save("accuracy.png", figure(rows))
    return failed
