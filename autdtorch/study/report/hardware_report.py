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
from autdtorch.hardware.log import Evaluation, EvaluationLog
from autdtorch.hardware.preflight import Preflight
from autdtorch.methods.solution import Solution
from autdtorch.objectives.simulated import Objective
from autdtorch.plot.trials import plot_convergence
from autdtorch.study.report.tables import code, fenced, table
from autdtorch.utils.files import naming, replace_file

REPORT_FILE = "report.md"
_FIGURE = "convergence.png"

_TEXT = """# Hardware trial: {method} on {device}{emulated}

Scene {scene}, {begin} to {end}; autdtorch {version}. Made by

{command}

- {evaluations} evaluations, {rate}
- outputs on for {seconds_on:.1f} s in all, the pre-flight check included
- weakest focus found: **{again:#.4g} Pa**, the drive played once more; {weakest:#.4g} Pa when it was found
- transducers driven as in the simulated trial: {same} of {transducers}

## Measured beside simulated

{points}

All are of the drive that was found. *When found* is the best of many readings, and so on average a little too
high where they are noisy; *again* is the mean of {readings} after the search. *Simulated* is without the
transducers that are not heard. The simulation knows neither the strength of the transducers nor the
calibration of the sensor, so that its pressures are multiplied by one factor, {scale:#.4g}, fitted to all
{evaluations} evaluations by least squares. These then differ by {misfit} % (rms, of the rms measured).

## By control point

{fits}

The factor that fits all evaluations at this point alone, and what then differs (rms, of the rms measured). A
point that stands apart has another calibration or place than was said.

## Convergence

![convergence](convergence.png)

Best score so far. The simulation's is another trial: the same method with the same seed, all transducers
heard and no noise, times the factor.

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


def _percent(share: float) -> str:
    return f"{round(100 * share, 6):.2g}"  # less is rounding


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
    """Write `report.md` and its figure.

    Args:
        folder: for both; made if need be.
        log: of the trial.
        found: what the method found on the bench, one trial.
        again: (R, P) [Pa], readings of that drive after the search.
        simulated: the scene, simulated without noise on the levels of the device.
        expected: what the same method found there.
        preflight: the check before the trial.
        command: the command line that repeats it.

    Returns:
        The path of the report.

    Raises:
        OSError: the folder cannot be made or written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    evaluations = log.evaluations
    begin, end = (datetime.fromisoformat(evaluations[place].time) for place in (0, -1))
    drives = torch.stack([evaluation.drive for evaluation in evaluations])
    scene = simulated.scene
    heard = torch.ones(len(scene.array), dtype=torch.float64, device="cpu")
    heard[preflight.dead] = 0
    measured, there = torch.stack([one.pressure for one in evaluations]), simulated(heard * drives)
    fit = compare(measured, there)
    histories = {"bench": found.history, "simulation": fit.scale * expected.history}
    with naming(folder / _FIGURE):
        plot_convergence({scene.name: histories}).savefig(folder / _FIGURE)
    same = torch.isclose(found.drive, expected.drive, rtol=0, atol=1e-9)
    mean = again.mean(dim=0)
    pressures = found.pressure[0], mean, fit.scale * simulated(heard * found.drive)[0]
    text = _TEXT.format(
        method=log.origin.get("method", "a method"),
        device=log.origin["device"],
        emulated=", emulated" if log.origin.get("emulated") else "",
        scene=code(scene.name),
        command=fenced(command),
        version=autdtorch.__version__,
        begin=f"{begin:%Y-%m-%d %H:%M:%S}",
        end=f"{end:%Y-%m-%d %H:%M:%S} UTC",
        evaluations=len(evaluations),
        rate=_rate(evaluations),
        seconds_on=log.seconds_on,
        again=mean.min(),
        weakest=found.pressure.min(),
        readings=f"{len(again)} readings" if len(again) > 1 else "one reading",
        same=int(same.sum()),
        transducers=same.numel(),
        points=_points(scene.control_points, *pressures),
        fits=_fits(scene.control_points, measured, there),
        scale=fit.scale,
        misfit=_percent(fit.misfit),
        preflight=_preflight(preflight),
        settings=table([["setting", "value"], *_settings(log.origin)]),
    )
    path = folder / REPORT_FILE
    replace_file(path, text.encode())
    return path


def _settings(origin: Mapping[str, object]) -> list[list[str]]:
    return [[name, code(_value(own))] for name, own in origin.items()]


def _value(own: object) -> str:
    """A setting, as JSON; numbers in a row as a range."""
    if isinstance(own, list) and len(own) > 2 and all(isinstance(one, int) for one in own):
        low, high = own[0], own[-1]
        if own == list(range(low, high + 1)):
            return f"{low} to {high}"
    return json.dumps(own, ensure_ascii=False)


def _rate(evaluations: Sequence[Evaluation]) -> str:
    """From the median interval, which an interruption does not change."""
    times = torch.tensor(
        [datetime.fromisoformat(evaluation.time).timestamp() for evaluation in evaluations],
        dtype=torch.float64,
        device="cpu",
    )
    interval = float(times.diff().median()) if len(times) > 1 else 0.0
    return f"one in {1e3 * interval:.3g} ms (median)"


def _points(places: torch.Tensor, *pressures: torch.Tensor) -> str:
    rows = [["control point [mm]", "when found [Pa]", "again [Pa]", "simulated [Pa]", "again / simulated"]]
    columns = [[*pressure.tolist(), float(pressure.min())] for pressure in pressures]
    for name, when_found, again, simulated in zip([*_names(places), "weakest"], *columns, strict=True):
        values = (f"{value:#.4g}" for value in (when_found, again, simulated))
        rows.append([name, *values, f"{again / simulated:.3f}"])
    return table(rows)


def _fits(places: torch.Tensor, measured: torch.Tensor, simulated: torch.Tensor) -> str:
    rows = [["control point [mm]", "factor", "differs by [%]"]]
    for name, here, there in zip(_names(places), measured.T, simulated.T, strict=True):
        fit = compare(here, there)
        rows.append([name, f"{fit.scale:#.4g}", _percent(fit.misfit)])
    return table(rows)


def _names(places: torch.Tensor) -> list[str]:
    return ["(" + ", ".join(f"{1e3 * one:.4g}" for one in place.tolist()) + ")" for place in places]


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
