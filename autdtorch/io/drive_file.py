"""Drives and sequences of them in files: with full precision and the array, or as levels of a device."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from autdtorch.hardware.devices import DEVICES
from autdtorch.io.array_file import NORMAL_COLUMNS, PLACE_COLUMNS
from autdtorch.io.csv_table import read_table, write_table
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.drive import (
    amplitudes_of,
    drive_from_phases,
    phases_of,
    validate_drive,
)
from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.numpy_file import read_arrays, write_arrays
from autdtorch.utils.validation import ArrayLike, path_of, real_tensor, require_kind, require_one_of, within

_FORMATS = (".csv", ".npz")
_LEVEL_COLUMNS = {f"{name} {column}": "" for name, device in DEVICES.items() for column in device.columns}
_PLAIN_COLUMNS = {"phase": "rad", "amplitude": ""}
_NUMBERING = {"frame": "", "unit": "", "transducer": ""}
_COLUMNS = _NUMBERING | PLACE_COLUMNS | NORMAL_COLUMNS | _PLAIN_COLUMNS | _LEVEL_COLUMNS


def save_drive(
    path: str | os.PathLike[str], drive: ArrayLike, array: TransducerArray, device: str | None = None
) -> None:
    """Write a drive, or the frames of a sequence, with full precision or as the levels of a device.

    Without `device`, `.csv` has the columns transducer, x, y, z [m], nx, ny, nz, phase [rad] and amplitude.
    `.npz` has the arrays drive (M,), positions, normals, source_strength and radius. `load_array` reads the
    array from both; .csv has neither strength nor radius.

    With `device`, the drive is rounded to its phase levels. The array must have the order of the device, as
    `TransducerArray.autd3`, `.sonicsurface` and `.openmpd` have. `.csv` has the columns unit, transducer and,
    for example, autd3 phase and autd3 intensity. `.npz` has the name `device` and uint8 arrays (units,
    transducers per unit): phase, and for AUTD3 intensity, for OpenMPD and Ultraino duty.

    A sequence has one axis more: `.csv` begins with the column frame, from 0, and arrays of `.npz` have the
    frames first. Rounding to levels changes the steps between frames, by one level at most.

    Args:
        path: of the file, which is replaced; the suffix decides the format.
        drive: complex (M,), or (T, M) for T frames, |q| <= 1.
        array: the M transducers.
        device: a name in `hardware.DEVICES`, such as "autd3", or None.

    Raises:
        ValueError: another suffix or device, not a drive of the array, or an M that is not a multiple of the
            transducers of a unit.
    """
    path = path_of("path", path, suffixes=_FORMATS)
    require_kind("array", array, TransducerArray)
    checked = validate_drive(drive, len(array)).detach().cpu()
    if checked.ndim not in (1, 2) or 0 in checked.shape:
        accepted = f"must be ({len(array)},), or (T, {len(array)}) for T frames"
        raise ValueError(f"drive: shape {tuple(checked.shape)}; {accepted}")
    if device is None:
        columns, arrays = _plain(checked, array)
    else:
        require_one_of("device", device, DEVICES)
        columns, arrays = _levelled(checked, device)
    if path.suffix.lower() == ".csv":
        write_table(path, columns)
    else:
        write_arrays(path, arrays)


def load_drive(path: str | os.PathLike[str]) -> torch.Tensor:
    """Read a drive (M,) or frames (T, M), complex128, of `save_drive`, levels as the device plays them.

    Args:
        path: of the file; the suffix decides the format.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, or a file without a drive. The message names the file, and the line where
            it has lines.
    """
    path = path_of("path", path, suffixes=_FORMATS)
    if path.suffix.lower() == ".csv":
        table = read_table(path, _COLUMNS)
        for name, device in DEVICES.items():
            if any(f"{name} {column}" in table for column in device.columns):
                return _in_frames(path, _played(path, name, table), table)
        if missing := [column for column in _PLAIN_COLUMNS if column not in table]:
            accepted = "must have phase and amplitude, or a device's"
            raise ValueError(f"{path}: no column {', '.join(missing)}; {accepted}")
        with within(path):
            drive = drive_from_phases(table["phase"], table["amplitude"])
        return _in_frames(path, drive, table)
    arrays = read_arrays(path)
    if "device" in arrays:
        name = str(arrays["device"])
        require_one_of(f"{path}: device", name, DEVICES)
        shapes = {arrays[column].shape for column in DEVICES[name].columns if column in arrays}
        if len(shapes) > 1 or any(len(shape) > 3 or 0 in shape for shape in shapes):
            raise ValueError(
                f"{path}: levels of shapes {shapes}; must be (units, M) or (T, units, M), all alike"
            )
        levels = {f"{name} {key}": value.reshape(-1) for key, value in arrays.items()}
        frames = [len(arrays[DEVICES[name].columns[0]])] if max(map(len, shapes), default=0) == 3 else []
        return _played(path, name, levels).reshape(*frames, -1)
    if "drive" not in arrays:
        raise ValueError(f"{path}: no array 'drive'; must be written by save_drive")
    stored = arrays["drive"]
    with within(path):
        if stored.ndim not in (1, 2) or stored.size == 0:
            raise ValueError(f"drive: shape {stored.shape}; must be (M,), or (T, M) for T frames")
        return validate_drive(stored, stored.shape[-1])


def _in_frames(path: Path, drive: torch.Tensor, table: Mapping[str, AnyArray]) -> torch.Tensor:
    """Return the drive (M,) of all rows of a table, or the frames (T, M) that the table numbers."""
    if "frame" not in table:
        return drive
    frames = len(np.unique(table["frame"]))
    if not np.array_equal(table["frame"], np.repeat(np.arange(frames), len(drive) // frames)):
        raise ValueError(f"{path}: column frame; must count from 0, with as many rows for each frame")
    return drive.reshape(frames, -1)


def _plain(drive: torch.Tensor, array: TransducerArray) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return columns by header and arrays by name of a drive with full precision."""
    positions, normals = array.positions.numpy(), array.normals.numpy()
    columns = {"transducer": np.arange(len(array))}
    columns |= {f"{name} [m]": positions[:, axis] for axis, name in enumerate(PLACE_COLUMNS)}
    columns |= {name: normals[:, axis] for axis, name in enumerate(NORMAL_COLUMNS)}
    columns = _numbered(columns, drive)
    flat = drive.flatten()
    columns |= {"phase [rad]": phases_of(flat).numpy(), "amplitude": amplitudes_of(flat).numpy()}
    arrays = {"drive": drive.numpy(), "positions": positions, "normals": normals}
    return columns, arrays | {"source_strength": array.source_strength, "radius": array.radius}


def _levelled(drive: torch.Tensor, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return columns by header and arrays by name of the levels for a device."""
    device = DEVICES[name]
    count = drive.shape[-1]
    units, rest = divmod(count, device.board)
    if rest:
        raise ValueError(f"drive: {count} transducers; must be a multiple of {device.board} for {name}")
    levels = dict(zip(device.columns, (level.numpy() for level in device.levels(drive)), strict=True))
    unit, transducer = np.divmod(np.arange(count), device.board)
    columns = _numbered({"unit": unit, "transducer": transducer}, drive)
    columns |= {f"{name} {key}": level.reshape(-1) for key, level in levels.items()}
    shape = *drive.shape[:-1], units, device.board
    arrays = {key: level.astype(np.uint8).reshape(shape) for key, level in levels.items()}
    return columns, arrays | {"device": name}


def _numbered(columns: dict[str, Any], drive: torch.Tensor) -> dict[str, Any]:
    """Return columns (M,), repeated for each frame of drives (T, M) and numbered by frame."""
    if drive.ndim == 1:
        return columns
    frames = {"frame": np.repeat(np.arange(len(drive)), drive.shape[1])}
    return frames | {name: np.tile(values, len(drive)) for name, values in columns.items()}


def _played(path: Path, name: str, stored: Mapping[str, AnyArray]) -> torch.Tensor:
    """Return the drive of a device for levels stored by names such as "autd3 phase"."""
    device = DEVICES[name]
    wanted = [f"{name} {column}" for column in device.columns]
    if missing := [column for column in wanted if column not in stored]:
        raise ValueError(f"{path}: no {', '.join(missing)}; must have {', '.join(wanted)}")
    with within(path):
        levels = [real_tensor(column, stored[column]) for column in wanted]
        # The device refuses fractions, which stay floats.
        return device.drive(*(one.long() if torch.equal(one, one.round()) else one for one in levels))
