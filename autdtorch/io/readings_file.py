"""Files of readings: CSV, NumPy, logs of hardware trials, and data frames."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from autdtorch.hardware.devices import DEVICES
from autdtorch.hardware.link import AmplitudeScale, Wiring
from autdtorch.hardware.log import read_log
from autdtorch.io.csv_table import write_table
from autdtorch.io.drive_file import load_drive
from autdtorch.io.picture_file import PICTURES, load_picture, pictures_of_evaluations
from autdtorch.io.readings_columns import Named, checked_names
from autdtorch.io.readings_table import Table, Units, csv_table, frame_table, plain_number, readings_of
from autdtorch.io.readings_units import angle_unit, phase_unit, pressure_unit
from autdtorch.objectives.readings import Readings
from autdtorch.scene.drive import amplitudes_of, phases_of
from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.files import path_of, read_arrays, write_arrays
from autdtorch.utils.validation import (
    ArrayLike,
    complex_tensor,
    invalid,
    points_tensor,
    require_kind,
    require_known,
    within,
)

logger = logging.getLogger(__name__)

_LOG = "trial.jsonl"  # in the folder of a hardware trial
_APART = 2e-3  # of places in a picture [m], a quarter of a wavelength at 40 kHz
_TITLES = {"phases": "phase", "amplitudes": "amplitude", "pressure": "pressure", "phase": "pressure phase"}
_UNITS = {"pressure": "Pa peak", "phase": "rad"}  # of files that `save_readings` writes


def load_readings(
    source: Any,
    *,
    columns: Named | None = None,
    phases: str | int | None = None,
    pressure: str | None = None,
    phase: str | None = None,
    drives: ArrayLike | None = None,
    points: ArrayLike | None = None,
) -> Readings:
    """Read drives and the pressures that sensors said.

    - `.csv`, separated by commas, semicolons, tabs or blanks, and data frames of pandas or polars: a row has
      a drive and pressures. Titles of the columns are as `phase 0 [deg]`, numbered from 0 or 1;
      `amplitude 0`, by default 1; `pressure 0 [kPa rms]`; `pressure phase 0 [rad]`. With `x [mm]`, `y [mm]`
      and `z [mm]`, each row has any point and its pressure. Empty cells and nan are gaps of the pressure.
    - `.npz` of `save_readings`, or with the arrays `drives` or `phases` (R, M) and `pressure` (R, P). Others
      are optional: `amplitudes` (R, M), `phase` (R, P), `deviation` (R, P) [Pa peak] and `points` (P, 3) [m].
    - `.jsonl`: the log of a hardware trial, or the folder that holds it. Drives are those that the device
      played.
    - The folder `pictures` of a trial with a camera: a row for each evaluation, at places 2 mm apart, nearer
      than which errors are alike. `points` in the plane choose other places.

    Units are stated by the titles or here, and never guessed. Phases are phi of the drive q = a e^{-i phi};
    titles `arg q 0 [deg]`, or `phases="arg deg"`, state arg q = -phi, and so do levels. Phases of the
    pressure have the time factor e^{-i w t}.

    Args:
        source: path of a file, or a data frame.
        columns: where the titles do not say what columns hold: the number of columns of each quantity, in
            order, such as ``{"phase": 16, "pressure": 4}``, with "skip" for others; or the titles to read,
            such as ``{"phase": "ch*", "pressure": ["mic1", "mic2"]}``, those of a pattern by their numbers.
            Quantities are x, y, z, phase, amplitude, pressure and pressure phase.
        phases: unit of the drive's phases: "rad", "deg", "arg rad", "arg deg", a number of levels in a turn
            such as 32, or the device whose levels they are, such as "sonicsurface".
        pressure: unit and kind of the pressures, such as "Pa rms", "kPa peak" or "mPa peak-to-peak", or what
            the titles lack of it; "dB" is re 20 uPa, of the RMS pressure.
        phase: unit of the phases of the pressure: "rad" or "deg".
        drives: of the rows (R, M), or of all rows (M,), where the file has only pressures, as of a scan.
        points: (P, 3) [m] of the columns of pressures; by default those of the file, or the control points.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a unit that is stated nowhere, or numbers that belie it; a column of an unknown title; a
            number out of range, with its row and column; or a file of another kind.

    Warns:
        ScaleWarning: phases in rad seem to be degrees, or the other way round.
    """
    units = Units(
        None if phases is None else phase_unit("phases", phases),
        None if pressure is None else pressure_unit("pressure", pressure),
        None if phase is None else angle_unit("phase", phase),
    )
    named = checked_names(columns)
    rows = None if drives is None else _drives(drives)
    places = None if points is None else points_tensor("points", points).cpu()
    if hasattr(source, "columns") and hasattr(source, "to_numpy"):
        return readings_of(frame_table(source), named, units, rows, places)
    path = path_of("source", source, "a file, or a data frame")
    if path.is_dir() and path.name == PICTURES:
        _refuse(path, {"columns": named, **units._asdict(), "drives": rows})
        return _from_pictures(path, places)
    path = path / _LOG if path.is_dir() else path
    if not (path.suffix or path.exists()):
        raise FileNotFoundError(f"source: {path}; there is no such file or folder")
    path = path_of("source", path, suffixes=(".csv", ".npz", ".jsonl"))
    if not path.is_file():
        raise FileNotFoundError(f"source: {path}; there is no such file")
    if path.suffix.lower() == ".csv":
        return readings_of(csv_table(path, named), named, units, rows, places)
    _refuse(path, {"columns": named})
    if path.suffix.lower() == ".npz":
        arrays = read_arrays(path)
        deviation = arrays.pop("deviation", None)
        table, stored = _array_table(path, arrays)
        if rows is not None and stored is not None:
            raise ValueError(f"drives: given, but {path} has drives; must be one of both")
        readings = readings_of(table, None, units, rows if stored is None else stored, places)
        with within(path):
            return (
                readings
                if deviation is None
                else replace(readings, deviation=torch.as_tensor(deviation, device="cpu"))
            )
    _refuse(path, {**units._asdict(), "drives": rows})
    return _from_log(path, places)


def save_readings(path: str | os.PathLike[str], readings: Readings) -> None:
    """Write readings to a file that `load_readings` reads without further arguments.

    `.csv` has a row for each drive, with `phase 0 [rad]`, `amplitude 0`, `pressure 0 [Pa peak]` and so on;
    gaps are nan, and comments have the points. `.npz` is exact, and alone has deviations.

    Args:
        path: of the file, which is replaced; the suffix decides the format.
        readings: to write.
    """
    path = path_of("path", path, suffixes=(".csv", ".npz"))
    require_kind("readings", readings, Readings)
    if path.suffix.lower() == ".npz":
        names = ("drives", "pressure", "points", "phase", "deviation")
        parts = {name: getattr(readings, name) for name in names}
        arrays = {name: part.numpy() for name, part in parts.items() if part is not None}
        write_arrays(path, arrays | {"unit": _UNITS["pressure"]})
        return
    if readings.deviation is not None:
        raise ValueError(f"path: {path}; must be .npz for readings with deviations")
    columns = _numbered("phase {} [rad]", phases_of(readings.drives))
    columns |= _numbered("amplitude {}", amplitudes_of(readings.drives).clamp(max=1.0))
    columns |= _numbered(f"pressure {{}} [{_UNITS['pressure']}]", readings.pressure)
    if readings.phase is not None:
        columns |= _numbered("pressure phase {} [rad]", readings.phase)
    places = [] if readings.points is None else readings.points.tolist()
    comments = [f"point {number} [m]: {' '.join(map(repr, place))}" for number, place in enumerate(places)]
    write_table(path, columns, comments)


def _numbered(title: str, values: torch.Tensor) -> dict[str, AnyArray]:
    """Return columns (R,) of numbers (R, C) by their titles."""
    return {title.format(number): column for number, column in enumerate(values.T.numpy())}


def _drives(value: ArrayLike) -> torch.Tensor:
    """Return drives (R, M) or (M,) as complex128 on the CPU; `Readings` checks their amplitudes."""
    drives = complex_tensor("drives", value).detach().cpu()
    if drives.ndim not in (1, 2) or drives.numel() == 0:
        raise ValueError(f"drives: shape {tuple(drives.shape)}; must be (R, M), or (M,) for all rows")
    return drives


def _refuse(path: Path, arguments: Mapping[str, object]) -> None:
    for name, value in arguments.items():
        if value is not None:
            raise invalid(name, str(value), f"must not be given: {path} states its own")


def _array_table(path: Path, arrays: dict[str, AnyArray]) -> tuple[Table, torch.Tensor | None]:
    """Return the arrays of a NumPy file side by side, and its drives if it has them as complex numbers."""
    require_known(str(path), arrays, (*_TITLES, "drives", "points", "unit"), "array")
    if "pressure" not in arrays:
        raise ValueError(f"{path}: no array 'pressure'; must have pressure, and drives or phases")
    drives = None
    with within(path):
        if "drives" in arrays:
            drives = _drives(arrays["drives"])
            if drives.ndim == 1:  # one drive, and all points
                arrays = {name: value[None] if name in _TITLES else value for name, value in arrays.items()}
        points = points_tensor("points", arrays["points"]) if "points" in arrays else None
    titles, parts = [], []
    for name, title in _TITLES.items():
        if name in arrays:
            part = arrays[name][:, None] if arrays[name].ndim == 1 else arrays[name]
            if part.ndim != 2 or 0 in part.shape or len(part) != len(arrays["pressure"]):
                rows = len(arrays["pressure"]) if arrays["pressure"].ndim else "R"
                raise ValueError(f"{path}: {name}: shape {arrays[name].shape}; must be ({rows}, ...)")
            unit = f" [{_UNITS[name]}]" if "unit" in arrays and name in _UNITS else ""
            titles += [f"{title} {number}{unit}" for number in range(part.shape[1])]
            parts.append(part.astype(object))
    if "unit" in arrays and str(arrays["unit"]) != _UNITS["pressure"]:
        raise invalid(
            f"{path}: unit", str(arrays["unit"]), f"must be {_UNITS['pressure']}, as of save_readings"
        )
    rows = np.concatenate(parts, axis=1).tolist()
    names = [f"row {number}" for number in range(len(rows))]
    return Table(str(path), titles, rows, names, plain_number, points), drives


def _from_log(path: Path, points: torch.Tensor | None) -> Readings:
    """Return the readings of a hardware trial, with the drives that its device played."""
    origin, evaluations = read_log(path)
    if (quantity := origin.get("quantity")) is not None:
        raise ValueError(f"{path}: readings of {quantity}; must be pressures")
    if not evaluations:
        raise ValueError(f"{path}: no evaluation; must have at least one")
    drives = torch.stack([evaluation.drive for evaluation in evaluations])
    pressure = torch.stack([evaluation.pressure for evaluation in evaluations])
    known = [evaluation.deviation for evaluation in evaluations if evaluation.deviation is not None]
    deviation = torch.stack(known) if len(known) == len(evaluations) else None
    if known and deviation is None:
        count = len(evaluations)
        logger.warning("%s: %d of %d evaluations have deviations: none is used", path, len(known), count)
    return Readings(_played(origin, drives), pressure, points, deviation=deviation)


def _from_pictures(folder: Path, points: torch.Tensor | None) -> Readings:
    """Return the readings of a trial's pictures, with the drives that its device played."""
    paths = pictures_of_evaluations(folder)
    if not paths:
        raise ValueError(f"{folder}: no picture of an evaluation; must have at least one")
    pictures = [load_picture(path) for path in paths]
    places = pictures[0].plane.points(_APART).reshape(-1, 3) if points is None else points
    pressure, deviation = map(torch.stack, zip(*(picture.at(places) for picture in pictures), strict=True))
    origin, _ = read_log(folder.parent / _LOG)
    drives = torch.stack([load_drive(path) for path in paths])
    return Readings(_played(origin, drives), pressure, places, deviation=deviation)


def _played(origin: Mapping[str, Any], drives: torch.Tensor) -> torch.Tensor:
    """Return drives (N, M) at the levels of a trial's device; boards with their own corrections play any."""
    device = next((device for device in DEVICES.values() if device.name == origin.get("device")), None)
    if device is None:
        name = origin.get("device")
        logger.warning("%r is not in hardware.DEVICES: drives are as asked for, not at its levels", name)
    if device is None or "boards" in origin:
        return drives
    transducers = origin["transducers"]
    if (boards := max(transducers) // device.board + 1) > 1:
        device = device.with_boards(boards)
    return AmplitudeScale(Wiring(device, transducers), origin["amplitude limit"]).quantised(drives)
