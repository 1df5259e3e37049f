"""The report of a hardware trial: measured pressures compared with the simulation."""

from __future__ import annotations

import json
import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

import autdtorch
from autdtorch.hardware.log import Evaluation, EvaluationLog
from autdtorch.hardware.preflight import Preflight
from autdtorch.methods.solution import Solution
from autdtorch.objectives.objective import Objective
from autdtorch.plot.trials import plot_convergence
from autdtorch.study.report.document import code, rendered
from autdtorch.utils.files import naming, replace_file

REPORT_FILE = "report.md"
_FIGURE = "convergence.png"
_TIME = "%Y-%m-%d %H:%M:%S"


@dataclass(frozen=True)
class Comparison:
    """A least-squares fit of simulated to measured pressures."""

    scale: float  # factor from simulated to measured pressures
    misfit: float  # rms of the remaining difference, divided by the measured rms


def compare(measured: torch.Tensor, simulated: torch.Tensor) -> Comparison:
    """Fit one factor to pressures (..., P) [Pa]."""
    scale = (measured * simulated).sum() / simulated.square().sum()
    misfit = (measured - scale * simulated).square().mean().sqrt() / measured.square().mean().sqrt()
    return Comparison(float(scale), float(misfit))


def _percent(share: float) -> str:
    return f"{round(100 * share, 6):.2g}"  # smaller digits are rounding


def write_hardware_report(
    folder: str | os.PathLike[str],
    log: EvaluationLog,
    found: Solution,
    again: torch.Tensor,
    simulated: Objective,
    expected: Solution,
    preflight: Preflight,
    command: str,
) -> Path:
    """Write `report.md` and its figure into a folder, which is made if it does not exist; return its path.

    Args:
        folder: folder for both.
        log: evaluation log of the trial.
        found: solution of the search on the bench, one trial.
        again: readings (R, P) [Pa] of that drive after the search.
        simulated: objective without noise, at the phase levels of the device.
        expected: solution of the same method on `simulated`.
        preflight: check before the trial.
        command: command line that repeats the trial.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    evaluations = log.evaluations
    begin, end = (datetime.fromisoformat(evaluations[place].time) for place in (0, -1))
    drives = torch.stack([evaluation.drive for evaluation in evaluations])
    scene = simulated.scene
    working = torch.ones(len(scene.array), dtype=torch.float64, device="cpu")
    working[preflight.dead] = 0
    measured, predicted = torch.stack([one.pressure for one in evaluations]), simulated(working * drives)
    fit = compare(measured, predicted)
    histories = {"bench": found.history, "simulation": fit.scale * expected.history}
    with naming(folder / _FIGURE):
        plot_convergence({scene.name: histories}).savefig(folder / _FIGURE)
    mean = again.mean(dim=0)
    pressures = found.pressure[0], mean, fit.scale * simulated(working * found.drive)[0]
    alone = preflight.pressure[preflight.pressure > preflight.threshold]
    text = rendered(
        "hardware.md",
        method=log.origin.get("method", "a method"),
        device=log.origin["device"],
        emulated=bool(log.origin.get("emulated")),
        scene=scene.name,
        command=command,
        version=autdtorch.__version__,
        begin=format(begin, _TIME),
        end=format(end, _TIME),
        evaluations=len(evaluations),
        interval=f"{1e3 * _interval(evaluations):.3g}",
        seconds_on=log.seconds_on,
        again=float(mean.min()),
        found=float(found.pressure.min()),
        readings=len(again),
        same=int(torch.isclose(found.drive, expected.drive, rtol=0, atol=1e-9).sum()),
        transducers=found.drive.numel(),
        points=_points(scene.control_points, *pressures),
        fits=_fits(scene.control_points, measured, predicted),
        scale=fit.scale,
        misfit=_percent(fit.misfit),
        alone=alone,
        preflight=preflight,
        settings=[["setting", "value"], *([name, code(_value(own))] for name, own in log.origin.items())],
    )
    path = folder / REPORT_FILE
    replace_file(path, text.encode())
    return path


def _value(own: Any) -> str:
    """Return a setting as JSON, consecutive integers as a range."""
    integers = isinstance(own, list) and len(own) > 2 and all(isinstance(one, int) for one in own)
    if integers and own == list(range(own[0], own[-1] + 1)):
        return f"{own[0]} to {own[-1]}"
    return json.dumps(own, ensure_ascii=False)


def _interval(evaluations: Sequence[Evaluation]) -> float:
    """Return the median interval [s] between evaluations, which an interruption does not change."""
    times = [datetime.fromisoformat(evaluation.time).timestamp() for evaluation in evaluations]
    return statistics.median_low(np.diff(times).tolist()) if len(times) > 1 else 0.0


def _points(places: torch.Tensor, *pressures: torch.Tensor) -> list[list[str]]:
    rows = [["control point [mm]", "when found [Pa]", "again [Pa]", "simulated [Pa]", "again / simulated"]]
    columns = [[*pressure.tolist(), float(pressure.min())] for pressure in pressures]
    for name, when_found, again, simulated in zip([*_names(places), "weakest"], *columns, strict=True):
        values = (f"{value:#.4g}" for value in (when_found, again, simulated))
        rows.append([name, *values, f"{again / simulated:.3f}"])
    return rows


def _fits(places: torch.Tensor, measured: torch.Tensor, simulated: torch.Tensor) -> list[list[str]]:
    rows = [["control point [mm]", "factor", "differs by [%]"]]
    for name, here, there in zip(_names(places), measured.T, simulated.T, strict=True):
        fit = compare(here, there)
        rows.append([name, f"{fit.scale:#.4g}", _percent(fit.misfit)])
    return rows


def _names(places: torch.Tensor) -> list[str]:
    return ["(" + ", ".join(f"{1e3 * one:.4g}" for one in place.tolist()) + ")" for place in places]
