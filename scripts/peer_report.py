"""What benchmark_peers.py writes: figures as JSON, a plot, and the generated block of peers.md."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path

from accuracy_report import percent
from generated_block import fill_in, measured, table
from matplotlib.figure import Figure

from autdtorch.plot.pareto import plot_pareto
from autdtorch.plot.style import TICK_SIZE

DOCUMENT = Path(__file__).parents[1] / "docs" / "peers.md"

OURS = "autdtorch"

NAMES = {"deepwave": "Deepwave", "devito": "Devito", "jwave": "j-Wave", "kwave": "k-wave-python"}

REQUIRED_CASE = "three cubes"
REQUIRED = (("fastest peer", tuple(NAMES), 50), ("k-wave-python", ("kwave",), 1000))
"""Of whom the fastest must take so many times as long as we do."""

LARGEST_ERROR = 0.2
"""Of points that ratios are taken at: what is further off tells nothing of use."""

ERRORS = (0.2, 0.1, 0.05, 0.03, 0.01)
"""That the time to reach is told of."""

STEADY = 1e-2
"""Distance to the steady state at which a peer may end, our default; told from the end of its run."""


@dataclass(frozen=True)
class Point:
    """A measurement.

    Attributes:
        case: the scene.
        program: who simulated.
        setting: how.
        periods: after which it ended, None if it decided itself.
        remaining: relative distance to the steady state, or to the run's last period.
        error: complex relative L2 error of the transfer matrix.
        seconds: run time, without imports and compilation.
        rate: cell updates a second, None if not counted.
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
    """What did not run, and why."""

    case: str
    program: str
    setting: str
    reason: str


def write_report(points: Sequence[Point], refusals: Sequence[Refusal], command: str, folder: Path) -> None:
    """Write peers.json, peers.png and peers.md into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    made = {"command": command, "date": date.today().isoformat(), "cores": os.cpu_count()}
    rows = ",\n ".join(json.dumps(_rounded(asdict(one))) for one in (*points, *refusals))
    text = f'{json.dumps(made)[:-1]}, "rows": [\n {rows}\n]}}\n'
    (folder / "peers.json").write_text(text, encoding="utf-8")
    figure(points, command).savefig(folder / "peers.png")
    picture = "![Error over run time](peers.png)"
    parts = [measured(command), picture, requirements(points), times(points), ratios(points), figures(points)]
    fill_in(DOCUMENT, "benchmark_peers", [*parts, *refused(refusals)], folder)


def time_ratio(peer: Point, points: Sequence[Point]) -> float | None:
    """Run time of a peer's point over that of our fastest run whose error is not larger, None without one."""
    ours = [p.seconds for p in points if (p.case, p.program) == (peer.case, OURS) and p.error <= peer.error]
    return peer.seconds / min(ours) if ours else None


def requirements(points: Sequence[Point]) -> str:
    """Whether we are as much faster to each error and a steady state as required, in `REQUIRED_CASE`."""
    lines = [f"| time to an error, {REQUIRED_CASE} | required | measured | kept |", "| --- |" + " --- |" * 3]
    steady = list(settled(points))
    for error in ERRORS:
        ours = _time_to(error, steady, REQUIRED_CASE, OURS)
        for who, peers, least in REQUIRED:
            found = [t for peer in peers if (t := _time_to(error, steady, REQUIRED_CASE, peer))]
            what = f"| {percent(error)}, {who} | at least {least} times ours |"
            if ours is None or not found:
                lines.append(f"{what} not reached | |")
                continue
            kept = "yes" if min(found) >= least * ours else "**no**"
            lines.append(f"{what} {min(found) / ours:.3g} times | {kept} |")
    return "\n".join(lines)


def times(points: Sequence[Point]) -> str:
    """Time in which each program comes to an error and a steady state, and how many times ours that is."""
    lines = [
        "| scene | program | " + " | ".join(f"to {percent(error)}" for error in ERRORS) + " | best error |"
    ]
    lines.append("| --- |" + " --- |" * (len(ERRORS) + 2))
    steady = list(settled(points))
    for case, program in dict.fromkeys((p.case, p.program) for p in points):
        cells = [case, NAMES.get(program, program)]
        for error in ERRORS:
            ours, mine = (_time_to(error, steady, case, name) for name in (OURS, program))
            told = f" ({mine / ours:.3g} times ours)" if program != OURS and mine and ours else ""
            cells.append(f"{mine:.3g} s{told}" if mine else "")
        best = min(p.error for p in steady if (p.case, p.program) == (case, program))
        lines.append("| " + " | ".join([*cells, percent(best)]) + " |")
    return "\n".join(lines)


def _time_to(error: float, points: Sequence[Point], case: str, program: str) -> float | None:
    mine = (p.seconds for p in points if (p.case, p.program) == (case, program) and p.error <= error)
    return min(mine, default=None)


def ratios(points: Sequence[Point]) -> str:
    """The smallest ratio of each peer in each scene, of ends in the steady state and of all ends."""
    lines = [
        "| scene | peer | times our time, steady | error there | times our time, any end | error there |"
    ]
    lines.append("| --- |" + " --- |" * 5)
    steady = list(settled(points))
    for case, peer in dict.fromkeys((p.case, p.program) for p in points if p.program != OURS):
        cells = [case, NAMES[peer]]
        for allowed in (steady, points):
            mine = [p for p in allowed if (p.case, p.program) == (case, peer) and p.error <= LARGEST_ERROR]
            told = [(ratio, p.error) for p in mine if (ratio := time_ratio(p, points)) is not None]
            ratio, error = min(told, default=(None, None))
            cells += ["", ""] if ratio is None or error is None else [f"{ratio:.3g}", percent(error)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def figures(points: Sequence[Point]) -> str:
    """A line for each setting in each scene."""
    lines = []
    for point in settled(points):
        ratio = time_ratio(point, points) if point.program != OURS else None
        cells = (
            point.case,
            NAMES.get(point.program, point.program),
            point.setting,
            "" if point.periods is None else str(point.periods),
            percent(point.error),
            f"{point.seconds:.3g} s",
            "" if point.rate is None else f"{point.rate / 1e6:.3g}",
            "" if ratio is None else f"{ratio:.3g}",
        )
        lines.append(cells)
    header = ("scene", "program", "setting", "periods", "error", "run time", "Mcell/s", "times our time")
    return table(header, lines)


def settled(points: Sequence[Point]) -> Iterator[Point]:
    """Of each run the first point from which on it stays in the steady state."""
    for run in dict.fromkeys((p.case, p.program, p.setting) for p in points):
        mine = [p for p in points if (p.case, p.program, p.setting) == run]
        late = [index for index, p in enumerate(mine) if p.remaining > STEADY]
        yield mine[late[-1] + 1 if late else 0]


def refused(refusals: Sequence[Refusal]) -> list[str]:
    """A table of what did not run, if there is any."""
    if not refusals:
        return []
    lines = [[r.case, NAMES[r.program], r.setting, r.reason] for r in refusals]
    return [table(["scene", "program", "setting", "did not run"], lines)]


def figure(points: Sequence[Point], command: str) -> Figure:
    """Error over run time, a panel for each scene; errors over 100 % are left out."""
    values: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for point in points:
        if point.error <= 1:
            by_program = values.setdefault(point.case, {})
            program = NAMES.get(point.program, point.program)
            by_program.setdefault(program, []).append((point.seconds, 100 * point.error))
    drawn = plot_pareto(
        values, "run time of the transfer matrix of one focus [s]", "relative error of the field [%]"
    )
    drawn.supxlabel(command, fontsize=TICK_SIZE)
    return drawn


def _rounded(row: dict[str, object]) -> dict[str, object]:
    """A row with four digits of each number."""
    return {name: float(f"{value:.4g}") if isinstance(value, float) else value for name, value in row.items()}
