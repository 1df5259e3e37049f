"""The report of a hardware trial: readings, pressures beside simulated ones, and a camera's plane."""

from __future__ import annotations

import itertools
import json
import statistics
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import torch

import autdtorch
from autdtorch.hardware.camera.picture import Picture
from autdtorch.hardware.log import EvaluationLog
from autdtorch.hardware.preflight import Preflight
from autdtorch.io.goal_section import score_label
from autdtorch.io.picture_file import AGAIN, PICTURES, load_picture
from autdtorch.methods.calibration.calibration import Calibration
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import Goal
from autdtorch.objectives.metrics import focus_metrics
from autdtorch.objectives.objective import Objective
from autdtorch.objectives.readings import deviation_by_square, deviation_of_square
from autdtorch.plot.calibration_figure import plot_calibration
from autdtorch.plot.data import outside_on_plane
from autdtorch.plot.plane_maps import camera_figure
from autdtorch.plot.trials import plot_convergence
from autdtorch.propagators import Propagator
from autdtorch.scene.geometry import cell_centers_of
from autdtorch.scene.scene import Scene
from autdtorch.study.report import alt_texts
from autdtorch.study.report.document import code, picture, rendered
from autdtorch.utils.array_types import REAL
from autdtorch.utils.files import naming, replace_file
from autdtorch.utils.text import in_digits

REPORT_FILE = "report.md"
_FIGURE, _CALIBRATION_FIGURE, _PLANE_FIGURE = "convergence.png", "calibration.png", "plane.png"


class ScaleFit(NamedTuple):
    """A least-squares fit of simulated to measured pressures."""

    scale: float  # factor from simulated to measured pressures
    misfit: float  # rms of the remaining difference, divided by the measured rms


def compare(measured: torch.Tensor, simulated: torch.Tensor) -> ScaleFit:
    """Fit one factor to pressures (..., P) [Pa]."""
    scale = (measured * simulated).sum() / simulated.square().sum()
    misfit = (measured - scale * simulated).square().mean().sqrt() / measured.square().mean().sqrt()
    return ScaleFit(float(scale), float(misfit))


def write_hardware_report(
    folder: Path,
    log: EvaluationLog,
    solution: Solution,
    again: torch.Tensor,
    propagator: Propagator,
    simulated: Objective,
    expected: Solution,
    preflight: Preflight,
    goal: Goal,
    command: str,
    calibration: Calibration | str,
) -> Path:
    """Write `report.md` and its figures into a folder; return its path.

    The drive of the `solution` on the bench was read `again` (R, P) [Pa]. `expected` is the solution of
    the same method on the `simulated` objective of the `propagator`, without noise and with the phase levels
    of the device. Both maximised the `goal`, or the bench the readings of another quantity, which is not
    compared with the simulation. The `calibration` is of the evaluations, or a text says why there is none.
    """
    evaluations, scene = log.evaluations, simulated.scene
    working = torch.ones(len(scene.array), **REAL)
    working[preflight.failed] = 0
    names, again_mean = _names(scene.control_points), again.mean(dim=0)
    readings = {"when found": solution.pressure[0], "again": again_mean}
    histories, compared = {"bench": solution.history}, {}
    if goal.of_pressures:
        measured = torch.stack([evaluation.pressure for evaluation in evaluations])
        predicted = simulated(working * torch.stack([evaluation.drive for evaluation in evaluations]))
        fit = compare(measured, predicted)
        readings["simulated"] = fit.scale * simulated(working * solution.drive)[0]
        # A pressure scales with the transducers; a score without unit does not.
        histories["simulation"] = (fit.scale if goal.unit else 1.0) * expected.history
        fits = _fits(names, measured, predicted)
        compared = {"scale": fit.scale, "misfit": _percent(fit.misfit), "fits": fits}
        compared |= measured_plane(folder, propagator, working * solution.drive[0], fit.scale, names)
    convergence = None
    if len(evaluations) > 1:
        label = score_label(f"{goal.name}, best so far", goal.unit)
        with naming(folder / _FIGURE):
            plot_convergence({scene.name: histories}, label=label).savefig(folder / _FIGURE)
        convergence = picture(_FIGURE, alt_texts.of_bench(histories, goal.unit))
    if isinstance(calibration, Calibration):
        with naming(folder / _CALIBRATION_FIGURE):
            plot_calibration(calibration).savefig(folder / _CALIBRATION_FIGURE)
    times = [datetime.fromisoformat(evaluation.time) for evaluation in evaluations]
    gaps = [(later - earlier).total_seconds() for earlier, later in itertools.pairwise(times)]
    text = rendered(
        "hardware.md",
        log=log,
        origin=log.origin,
        scene=scene.name,
        command=command,
        version=autdtorch.__version__,
        times=times,
        interval=statistics.median_low(gaps) if gaps else 0.0,  # an interruption does not change it
        solution=solution,
        is_best=bool(solution.score[0] >= solution.history[0].max()),  # `identify` computes its last drive
        convergence=convergence,
        goal=score_label(goal.name),
        of_pressures=goal.of_pressures,
        unit=goal.unit and f" {goal.unit}",
        score_again=float(goal(again_mean)),
        first=float(goal(evaluations[0].pressure)) if len(evaluations) > 1 else -torch.inf,
        readings=len(again),
        same=alike(solution.drive[0], expected.drive[0]),
        points=_points(names, readings, preflight.unit),
        **compared,
        **_calibrated(calibration),
        alone=preflight.pressure[preflight.pressure > preflight.threshold],
        preflight=preflight,
        settings=[
            ["setting", "value"],
            *([name, code(_as_text(value))] for name, value in log.origin.items()),
        ],
    )
    path = folder / REPORT_FILE
    replace_file(path, text.encode())
    return path


def alike(drive: torch.Tensor, expected: torch.Tensor) -> int:
    """Return how many transducers two drives (M,) drive alike, up to a phase that all have in common."""
    turns = (drive * expected.conj()).sgn()
    sounding = torch.cat([turns[turns != 0], turns.new_ones(1)])  # 1 where there is no other
    rounded = (1e6 * torch.view_as_real(sounding)).round()
    values, counts = torch.unique(rounded, dim=0, return_counts=True)
    common = torch.view_as_complex(values[counts.argmax()].contiguous()).sgn()
    return int(torch.isclose(drive, common * expected, rtol=0, atol=1e-5).sum())


def _calibrated(calibration: Calibration | str) -> dict[str, Any]:
    """Return the values of the template that tell of a calibration, or why there is none."""
    if isinstance(calibration, str):
        return {"calibration": None, "why_none": calibration}
    held = calibration.held_back
    assert held is not None
    return {
        "calibration": calibration,
        "held_back": {"after": _percent(held.error), "before": _percent(held.before)},
        "calibrated": picture(_CALIBRATION_FIGURE, alt_texts.of_calibration(calibration)),
    }


def _percent(share: float) -> str:
    return in_digits(round(100 * share, 6), 2)  # smaller digits are rounding


def _as_text(value: Any) -> str:
    """Return a setting as JSON, consecutive integers as a range."""
    integers = isinstance(value, list) and len(value) > 2 and all(isinstance(entry, int) for entry in value)
    if integers and value == list(range(value[0], value[-1] + 1)):
        return f"{value[0]} to {value[-1]}"
    return json.dumps(value, ensure_ascii=False)


def _points(names: list[str], readings: dict[str, torch.Tensor], unit: str) -> list[list[str]]:
    values = {what: torch.cat([each, each.min()[None]]) for what, each in readings.items()}
    columns = {f"{what} [{unit}]": [f"{value:#.4g}" for value in each] for what, each in values.items()}
    if "simulated" in values:
        columns["again / simulated"] = [f"{ratio:.3f}" for ratio in values["again"] / values["simulated"]]
    rows = zip([*names, "weakest"], *columns.values(), strict=True)
    return [["control point [mm]", *columns], *map(list, rows)]


def _fits(names: list[str], measured: torch.Tensor, simulated: torch.Tensor) -> list[list[str]]:
    rows = [["control point [mm]", "factor", "differs by [%]"]]
    for name, *pressures in zip(names, measured.T, simulated.T, strict=True):
        fit = compare(*pressures)
        rows.append([name, f"{fit.scale:#.4g}", _percent(fit.misfit)])
    return rows


def _names(places: torch.Tensor) -> list[str]:
    return ["(" + ", ".join(f"{1e3 * x:.4g}" for x in place.tolist()) + ")" for place in places]


def measured_plane(
    folder: Path, propagator: Propagator, drive: torch.Tensor, scale: float, names: Sequence[str]
) -> dict[str, Any]:
    """Draw the plane that a camera saw, and return its values for the report; none without pictures.

    Args:
        folder: of the trial, with the pictures of its drive; the figure goes there.
        propagator: the simulation of the bench.
        drive: the drive (M,) of the pictures.
        scale: factor from simulated to measured pressures.
        names: of the control points.
    """
    files = sorted((folder / PICTURES).glob(f"{AGAIN}_*.npz"))
    if not files:
        return {"plane": None}
    scene = propagator.scene
    measured = _mean([load_picture(file) for file in files])
    plane, counts = measured.plane, (measured.pressure.shape[0], measured.pressure.shape[1])
    field = scale * propagator.field(drive, cell_centers_of(plane, counts)).abs()
    simulated = Picture(plane, field, torch.zeros_like(field))
    with naming(folder / _PLANE_FIGURE):
        camera_figure(measured, field.numpy(), plane, scene).savefig(folder / _PLANE_FIGURE)
    air = torch.from_numpy(
        outside_on_plane(field.numpy(), plane, scene.obstacles, scene.reflectors)
    ).isfinite()
    size = measured.pressure[air].square().mean().sqrt()
    return {
        "plane": picture(_PLANE_FIGURE, alt_texts.of_measured(measured.pressure, field)),
        "off": float((measured.pressure - field)[air].square().mean().sqrt() / size),
        "noise": float(measured.deviation[air].square().mean().sqrt() / size),
        "pictures": len(files),
        "relative": measured.relative,
        "areas": [_area(field, scene) for field in (measured, simulated)],
        "foci": _foci(scene, names, measured, simulated),
        "doubts": measured.doubts,
    }


def _mean(pictures: Sequence[Picture]) -> Picture:
    """Return the picture of the mean |p|^2, with the deviation of this mean."""
    first, square = pictures[0], torch.stack([picture.pressure.square() for picture in pictures])
    of_square = torch.stack(
        [deviation_of_square(picture.pressure, picture.deviation) for picture in pictures]
    )
    mean = square.mean(dim=0)
    spread = of_square.square().mean(dim=0).sqrt() / len(pictures) ** 0.5
    doubts = dict.fromkeys(doubt for picture in pictures for doubt in picture.doubts)
    frames = sum(picture.frames for picture in pictures)
    pressure = mean.sqrt()
    deviation = deviation_by_square(pressure, spread)
    return Picture(first.plane, pressure, deviation, first.relative, frames, first.latency, tuple(doubts))


def _area(shown: Picture, scene: Scene) -> float:
    """Return the area per focus [m^2] (Fig. 3b)."""
    area = focus_metrics(shown.at(scene.control_points)[0], shown.pressure, shown.cell_area).area
    assert area is not None
    return float(area)


def _foci(scene: Scene, names: Sequence[str], measured: Picture, simulated: Picture) -> list[list[str]]:
    """Return a table of the maxima near the control points: distances [mm], and pressures [Pa]."""
    points = scene.control_points
    apart = torch.pdist(points).min() / 2 if len(points) > 1 else torch.inf
    radius = min(scene.wavelength, float(apart))
    places = [source.foci(points, radius) for source in (measured, simulated)]
    columns = [
        1e3 * (first - second).norm(dim=1) for first, second in ((places[0], places[1]), (places[1], points))
    ]
    columns += [field.at(place)[0] for field, place in zip((measured, simulated), places, strict=True)]
    head = ["from the simulated [mm]", "simulated, from the point [mm]", "measured [Pa]", "simulated [Pa]"]
    rows = [
        [name, f"{apart:.2f}", f"{off:.2f}", in_digits(loud, 4), in_digits(due, 4)]
        for name, apart, off, loud, due in zip(names, *(column.tolist() for column in columns), strict=True)
    ]
    return [["control point [mm]", *head], *rows]
