"""The report of `benchmark.py peers`: all points as JSON, a plot, and a block of peers.md."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path

from matplotlib.figure import Figure
from shared.document import command_line, fill_in, measured, percent, table

from autdtorch.plot.pareto import plot_pareto
from autdtorch.plot.style import TICK_SIZE

DOCUMENT = "peers.md"

OURS = "autdtorch"
NAMES = {"deepwave": "Deepwave", "devito": "Devito", "jwave": "j-Wave", "kwave": "k-wave-python"}

REQUIRED_CASE = "three cubes"
REQUIRED = (("fastest peer", tuple(NAMES), 50), ("k-wave-python", ("kwave",), 1000))
"""Required ratios of run times, peer over ours."""

ERRORS = (0.2, 0.1, 0.05, 0.03, 0.01)
"""Errors to which run times are compared."""

STEADY = 1e-2
"""Relative distance to the end of the run within which a peer counts as steady; our default tolerance."""


@dataclass(frozen=True)
class Point:
    """A measurement.

    Attributes:
        case: the scene.
        program: the simulator.
        setting: how it was run.
        periods: after which it ended; None if it decided itself.
        remaining: relative distance to the steady state, or to the end of the run.
        error: complex relative L2 error of the transfer matrix.
        seconds: run time, without imports and compilation.
        rate: cell updates per second; None if not counted.
    """

    case: str
    program: str
    setting: str
    periods: int | None
    remaining: float
    error: float
    seconds: float
    rate: float | None


@dataclass(frozen=True)
class Refusal:
    """A setting that did not run, and the reason."""

    case: str
    program: str
    setting: str
    reason: str


def write_report(points: Sequence[Point], refusals: Sequence[Refusal], folder: Path) -> None:
    """Write peers.json, peers.png and peers.md into `folder`."""
    steady = list(settled(points))
    parts = [
        measured(),
        "![Error over run time](peers.png)",
        "Time of steady runs to a given error, on any grid:",
        times(steady),
        f"Required for {REQUIRED_CASE}, in our times:",
        requirements(steady),
    ]
    if refusals:
        lines = [[r.case, NAMES[r.program], r.setting, r.reason] for r in refusals]
        parts.append(table(["scene", "program", "setting", "did not run"], lines))
    fill_in(DOCUMENT, "benchmark.py peers", parts, folder)
    made = {"command": command_line(), "date": date.today().isoformat(), "cores": os.cpu_count()}
    rows = ",\n ".join(json.dumps(_rounded(asdict(one))) for one in (*points, *refusals))
    text = f'{json.dumps(made)[:-1]}, "rows": [\n {rows}\n]}}\n'
    (folder / "peers.json").write_text(text, encoding="utf-8")
    figure(points).savefig(folder / "peers.png")


def settled(points: Sequence[Point]) -> Iterator[Point]:
    """Yield the first point of each run after which it stays in the steady state."""
    for run in dict.fromkeys((p.case, p.program, p.setting) for p in points):
        mine = [p for p in points if (p.case, p.program, p.setting) == run]
        late = [index for index, p in enumerate(mine) if p.remaining > STEADY]
        yield mine[late[-1] + 1 if late else 0]


def time_to(error: float, steady: Sequence[Point], case: str, *programs: str) -> float | None:
    """Return the shortest run time to an error; None if no point reaches it."""
    mine = (p.seconds for p in steady if p.case == case and p.program in programs and p.error <= error)
    return min(mine, default=None)


def requirements(steady: Sequence[Point]) -> str:
    """Return a table of required and measured ratios of run times in `REQUIRED_CASE`, as far as reached."""
    lines = []
    for error in ERRORS:
        ours = time_to(error, steady, REQUIRED_CASE, OURS)
        for who, peers, least in REQUIRED:
            theirs = time_to(error, steady, REQUIRED_CASE, *peers)
            if ours is not None and theirs is not None:
                kept = "yes" if theirs >= least * ours else "**no**"
                lines.append([f"{percent(error)}, {who}", f"at least {least}", f"{theirs / ours:.3g}", kept])
    return table(["time to an error", "required", "measured", "kept"], lines)


def times(steady: Sequence[Point]) -> str:
    """Return a table of the run times to each error."""
    cases, lines = list(dict.fromkeys(p.case for p in steady)), []
    found = dict.fromkeys((p.case, p.program) for p in steady)
    for case, program in sorted(found, key=lambda one: cases.index(one[0])):
        seconds = [time_to(error, steady, case, program) for error in ERRORS]
        best = min(p.error for p in steady if (p.case, p.program) == (case, program))
        cells = ["" if one is None else f"{one:.3g} s" for one in seconds]
        lines.append([case, NAMES.get(program, program), *cells, percent(best)])
    return table(["scene", "program", *(f"to {percent(error)}" for error in ERRORS), "best error"], lines)


def figure(points: Sequence[Point]) -> Figure:
    """Plot error over run time, a panel for each scene; errors over 100 % are left out."""
    values: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for point in points:
        if point.error <= 1:
            by_program = values.setdefault(point.case, {})
            program = NAMES.get(point.program, point.program)
            by_program.setdefault(program, []).append((point.seconds, 100 * point.error))
    drawn = plot_pareto(
        values, "run time of the transfer matrix of one focus [s]", "relative error of the field [%]"
    )
    drawn.supxlabel(command_line(), fontsize=TICK_SIZE)
    return drawn


def _rounded(row: dict[str, object]) -> dict[str, object]:
    return {name: float(f"{value:.4g}") if isinstance(value, float) else value for name, value in row.items()}
