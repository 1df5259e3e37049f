"""The report of a hardware trial: what was measured beside what the simulation says."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import torch

import autdtorch
from autdtorch.hardware.log import Evaluation
from autdtorch.hardware.preflight import Preflight
from autdtorch.objective import Objective
from autdtorch.optim.base import Solution
from autdtorch.plot import plot_convergence
from autdtorch.report_tables import table

REPORT_FILE = "report.md"
_FIGURE = "convergence.png"

_TEXT = """# Hardware trial

Made by `{command}` with autdtorch {version}, {begin} to {end}.

- {evaluations} evaluations, {rate}
- outputs on for {seconds_on:.1f} s in all
- weakest focus found: **{weakest:.4g} Pa**, as measured
- transducers driven as in the simulated trial: {same} of {transducers}

## Measured beside simulated

{points}

The drive that was found, in the simulation without the transducers that are not heard. It knows neither the
strength of the transducers nor the calibration of the sensor, so that its pressures are multiplied by one
factor, {scale:.4g}, fitted to all {evaluations} evaluations by least squares. These then differ by
{misfit:.2g} % (rms, of the rms measured).

## Convergence

![convergence](convergence.png)

Best score so far. Simulated: the same method with the same seed in the simulation, all transducers heard and
no noise, times the factor.

## Pre-flight check

{preflight}

## Settings

{settings}
"""


@dataclass(frozen=True)
class Comparison:
    """How the simulation fits what was measured.

    Attributes:
        scale: factor from simulated to measured pressures.
        misfit: rms of what then differs, as a share of the rms measured.
    """

    scale: float
    misfit: float


def compare(measured: torch.Tensor, simulated: torch.Tensor) -> Comparison:
    """Fit one factor to pressures (..., P) [Pa] by least squares."""
    scale = (measured * simulated).sum() / simulated.square().sum()
    misfit = (measured - scale * simulated).square().mean().sqrt() / measured.square().mean().sqrt()
    return Comparison(float(scale), float(misfit))


def write_hardware_report(
    folder: str | os.PathLike[str],
    evaluations: Sequence[Evaluation],
    found: Solution,
    simulated: Objective,
    expected: Solution,
    preflight: Preflight,
    settings: Mapping[str, object],
    command: str,
) -> Path:
    """Write `report.md` and its figure.

    Args:
        folder: for both; made if need be.
        evaluations: the trial's log.
        found: what the method found on the bench, one trial.
        simulated: the scene, simulated without noise on the levels of the device.
        expected: what the same method found there.
        preflight: the check before the trial.
        settings: what made the trial what it is.
        command: the command line that repeats it.

    Returns:
        The path of the report.

    Raises:
        OSError: the folder cannot be made or written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    begin, end = (datetime.fromisoformat(evaluations[place].time) for place in (0, -1))
    drives = torch.stack([evaluation.drive for evaluation in evaluations])
    scene = simulated.scene
    heard = torch.ones(len(scene.array), dtype=torch.float64)
    heard[preflight.dead] = 0
    fit = compare(torch.stack([evaluation.pressure for evaluation in evaluations]), simulated(heard * drives))
    histories = {"measured": found.history, "simulated": fit.scale * expected.history}
    plot_convergence({scene.name or "scene": histories}).savefig(folder / _FIGURE)
    same = torch.isclose(found.drive, expected.drive, rtol=0, atol=1e-9)
    text = _TEXT.format(
        command=command,
        version=autdtorch.__version__,
        begin=begin.isoformat(timespec="seconds"),
        end=end.isoformat(timespec="seconds"),
        evaluations=len(evaluations),
        rate=_rate(evaluations),
        seconds_on=evaluations[-1].seconds_on,
        weakest=found.pressure.min(),
        same=int(same.sum()),
        transducers=same.numel(),
        points=_points(
            scene.control_points, found.pressure[0], fit.scale * simulated(heard * found.drive)[0]
        ),
        scale=fit.scale,
        misfit=100 * fit.misfit,
        preflight=_preflight(preflight),
        settings=table(
            [["setting", "value"], *([name, json.dumps(value)] for name, value in settings.items())]
        ),
    )
    path = folder / REPORT_FILE
    path.write_text(text, encoding="utf-8")
    return path


def _rate(evaluations: Sequence[Evaluation]) -> str:
    """From the median interval, which an interruption does not change."""
    times = torch.tensor(
        [datetime.fromisoformat(evaluation.time).timestamp() for evaluation in evaluations],
        dtype=torch.float64,
    )
    interval = float(times.diff().median()) if len(times) > 1 else 0.0
    return f"one in {1e3 * interval:.3g} ms (median)"


def _points(places: torch.Tensor, measured: torch.Tensor, simulated: torch.Tensor) -> str:
    rows = [["control point [mm]", "measured [Pa]", "simulated [Pa]", "measured / simulated"]]
    for place, here, there in zip(places, measured, simulated, strict=True):
        name = "(" + ", ".join(f"{1e3 * coordinate:.4g}" for coordinate in place.tolist()) + ")"
        rows.append([name, f"{here:.4g}", f"{there:.4g}", f"{here / there:.3f}"])
    weakest = measured.min(), simulated.min()
    rows.append(["weakest", *(f"{value:.4g}" for value in weakest), f"{weakest[0] / weakest[1]:.3f}"])
    return table(rows)


def _preflight(check: Preflight) -> str:
    heard = check.pressure[check.pressure > check.threshold]
    lines = [
        f"The sensor hears {len(heard)} of {len(check.pressure)} transducers, each alone, with "
        f"{heard.min():.3g} to {heard.max():.3g} Pa (rms over the control points).\n"
        f"Silence is {check.silence:.3g} Pa, and the threshold {check.threshold:.3g} Pa."
    ]
    if check.dead:
        lines.append(f"**Not heard**, counted from 0: {', '.join(map(str, check.dead))}.")
    return "\n\n".join(lines)
