"""Drives and sequences of them in files: with full precision and the array, or as levels of a device."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from autdtorch.hardware.devices import DEVICES
from autdtorch.io.array_file import NORMAL_COLUMNS, OFFSET, PLACE_COLUMNS, SIZE_COLUMNS
from autdtorch.io.csv_table import CsvRows, Guessed, read_rows, table_of, write_table
from autdtorch.io.ultraino_file import SUFFIX, read_ultraino
from autdtorch.scene.arrays import TransducerArray, phase_offsets_of, radii_of, strengths_of
from autdtorch.scene.drive import amplitudes_of, drive_from_phases, phases_of, validate_drive
from autdtorch.scene.sequence import Sequence
from autdtorch.utils.array_types import AnyArray, Array
from autdtorch.utils.files import path_of, read_arrays, require_file, write_arrays
from autdtorch.utils.units import warn_user, warned_within
from autdtorch.utils.validation import ArrayLike, positive, real_tensor, require_kind, require_one_of, within

_FORMATS = (".csv", ".npz")
_LEVEL_COLUMNS = {f"{name} {column}": "" for name, device in DEVICES.items() for column in device.columns}
_PLAIN_COLUMNS = {OFFSET: "rad", "phase": "rad", "amplitude": ""}
_NUMBERING = {"frame": "", "unit": "", "transducer": ""}
_COLUMNS = _NUMBERING | PLACE_COLUMNS | NORMAL_COLUMNS | SIZE_COLUMNS | _PLAIN_COLUMNS | _LEVEL_COLUMNS
_COMMENT = "sequence: rate {rate!r} Hz, loop {loop}"
_TIMING = re.compile(r"#\s*sequence: rate (?P<rate>[\d.e+-]+) Hz, loop (?P<loop>True|False)\s*$")
_TURN = 2 * math.pi + 1e-6  # [rad], with room for rounding


def save_drive(
    path: str | os.PathLike[str], drive: ArrayLike, array: TransducerArray, device: str | None = None
) -> None:
    """Write a drive, or the frames of a sequence, with full precision or as the levels of a device.

    Without `device`, `.csv` has the columns transducer, x, y, z [m], nx, ny, nz, source_strength [Pa m],
    radius [m], phase [rad] and amplitude, and phase_offset [rad] if the array has phases. `.npz` has the
    arrays drive (M,), positions, normals, source_strength, radius and phase_offset. `load_array` reads the
    array from both.

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
    require_kind("array", array, TransducerArray)
    checked = validate_drive(drive, len(array)).detach().cpu()
    if checked.ndim not in (1, 2) or 0 in checked.shape:
        accepted = f"must be ({len(array)},), or (T, {len(array)}) for T frames"
        raise ValueError(f"drive: shape {tuple(checked.shape)}; {accepted}")
    _save(path, checked, array, device)


def save_sequence(
    path: str | os.PathLike[str], sequence: Sequence, array: TransducerArray, device: str | None = None
) -> None:
    """Write a sequence as `save_drive` writes frames, with its rate and whether it loops.

    `.csv` has them in a comment, `.npz` in the arrays rate and loop. `load_drive` reads the frames alone.

    Args:
        path: of the file, which is replaced; the suffix, `.csv` or `.npz`, decides the format.
        sequence: of frames (T, M).
        array: the M transducers.
        device: a name in `hardware.DEVICES`, such as "autd3", or None.

    Raises:
        ValueError: another suffix or device, or a sequence for another array.
    """
    require_kind("sequence", sequence, Sequence)
    require_kind("array", array, TransducerArray)
    frames = validate_drive(sequence.drives, len(array), "sequence.drives")
    _save(path, frames, array, device, {"rate": sequence.rate, "loop": sequence.loop})


def load_sequence(path: str | os.PathLike[str], rate: float | None = None) -> Sequence:
    """Read a sequence that `save_sequence` wrote, or frames; levels as the device plays them.

    Args:
        path: of a file of `save_sequence`, or of frames as `load_drive` reads them, `.csv` or `.npz`.
        rate: frames per second of a file that has no rate [Hz], whose frames become a loop.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, or a file without frames, rate or loop; the message names the file. Or a
            rate <= 0.
    """
    path = path_of("path", path, suffixes=_FORMATS)
    usual = None if rate is None else positive("rate", rate, "Hz")
    if path.suffix.lower() == ".csv":
        drives, timing = _from_csv(path), _timing_in_comment(path)
    else:
        timing = read_arrays(path)
        drives = _from_arrays(path, timing)
    if drives.ndim != 2:
        raise ValueError(f"{path}: a single drive; must have frames (T, M)")
    if usual is not None and "rate" not in timing:
        return Sequence(drives, usual)
    if missing := [name for name in ("rate", "loop") if name not in timing]:
        raise ValueError(
            f"{path}: no {' and '.join(missing)}; must be written by save_sequence, or rate given"
        )
    with within(path):
        return Sequence(drives, timing["rate"].tolist(), timing["loop"].tolist())


def _timing_in_comment(path: Path) -> dict[str, AnyArray]:
    """Return rate and loop of the comment that `save_sequence` writes at the top of a table."""
    with require_file(path).open(encoding="utf-8-sig") as lines:
        match = _TIMING.match(next(lines, ""))
    return (
        {"rate": np.array(float(match["rate"])), "loop": np.array(match["loop"] == "True")} if match else {}
    )


def _save(
    path: str | os.PathLike[str],
    frames: torch.Tensor,
    array: TransducerArray,
    device: str | None,
    timing: Mapping[str, Any] | None = None,
) -> None:
    """Write a drive (M,) or frames (T, M), perhaps with rate and loop."""
    path = path_of("path", path, suffixes=_FORMATS)
    if device is None:
        columns, arrays = _plain(frames, array)
    else:
        require_one_of("device", device, DEVICES)
        columns, arrays = _levelled(frames, device)
    if path.suffix.lower() == ".csv":
        write_table(path, columns, [_COMMENT.format(**timing)] if timing else [])
    else:
        write_arrays(path, arrays | dict(timing or {}))


def load_drive(path: str | os.PathLike[str]) -> torch.Tensor:
    """Read a drive (M,) or frames (T, M), complex128, levels as the device plays them.

    - `.csv` and `.npz` of `save_drive`, and `.npz` of `save_picture`.
    - `.csv` with the columns `phase [rad]` (or `[deg]`) and `amplitude`, by default 1; phases are phi. Names
      and units may be in a comment. Without names, one column is phases, and two are phases and amplitudes if
      only one of them can be amplitudes and not all numbers are whole. A unit that is not stated is taken as
      rad if the phases are within a turn and not all whole numbers. A `ScaleWarning` says what was inferred.
    - `.csv` of OpenMPD and AcousTools: numbers of frames and transducers, then a row of phases [rad] for each
      frame. These are arg q, at full amplitude, in the order of the file.
    - `.xml.gz` or `.xml`: a simulation of Ultraino, as it is shown, without its animations; its phases are
      arg q.

    Args:
        path: of the file; the suffix decides the format.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, or a file without a drive. The message names the file, and the line where
            it has lines.
    """
    path = path_of("path", path, suffixes=(*_FORMATS, SUFFIX, ".xml"))
    if path.suffix.lower() == ".csv":
        return _from_csv(path)
    if path.suffix.lower() in (".gz", ".xml"):
        return _from_ultraino(path)
    return _from_arrays(path, read_arrays(path))


def _from_arrays(path: Path, arrays: Mapping[str, AnyArray]) -> torch.Tensor:
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


def _from_csv(path: Path) -> torch.Tensor:
    rows = read_rows(path)
    if (frames := _openmpd_frames(rows)) is not None:
        return _of_arguments(path, frames, 1.0)
    table = table_of(rows, _COLUMNS, _drive_columns, _phase_unit)
    for name, device in DEVICES.items():
        if any(f"{name} {column}" in table for column in device.columns):
            return _in_frames(path, _played(path, name, table), table)
    if "phase" not in table:
        raise ValueError(f"{path}: no column phase; must have phase, or a device's such as autd3 phase")
    with within(path), warned_within(str(path)):
        drive = drive_from_phases(table["phase"], table.get("amplitude", 1.0))
    return _in_frames(path, drive, table)


def _openmpd_frames(rows: CsvRows) -> Array | None:
    """Return the phases (T, M) of rows after a first line with T and M; None for a table of another kind."""
    (_, first), *others = rows.lines
    counts = [int(cell) for cell in first if cell.isdecimal()]
    if len(first) != 2 or len(counts) != 2 or not others or len(others[0][1]) <= 2:
        return None
    frames = rows.numbers(1)
    if list(frames.shape) != counts:
        size = f"{frames.shape[0]} rows of {frames.shape[1]} phases"
        raise ValueError(f"{rows.path}: {size}; must be {counts[0]} of {counts[1]}, as in the first line")
    return frames


def _drive_columns(values: Array) -> list[str]:
    """Return the names of columns (R, C) without header: phase, or phase and amplitude in their order."""
    if values.shape[1] == 1:
        return ["phase"]
    amplitudes = [bool(((column >= 0) & (column <= 1)).all()) for column in values.T]
    whole = (values == values.round()).all()  # perhaps decimals that begin with a comma
    if len(amplitudes) != 2 or sum(amplitudes) != 1 or whole:
        accepted = (
            "the first line must name them, as in phase [rad],amplitude, and decimals begin with a point; "
            "frames of phases follow a line with their number and that of transducers"
        )
        raise ValueError(f"{values.shape[1]} columns without names; {accepted}")
    names = ["amplitude", "phase"] if amplitudes[0] else ["phase", "amplitude"]
    warn_user(f"columns without names; taken as {' and '.join(names)}, since only one is within 0 to 1")
    return names


def _phase_unit(kind: str, table: Mapping[str, Array]) -> Guessed | None:
    """Return the unit of columns that state none: rad, if the phases can hardly be levels or degrees."""
    if kind != "rad" or "phase" not in table:
        return None  # of the array, which is not used
    phases = table["phase"]
    if (np.abs(phases) <= _TURN).all() and not (phases == phases.round()).all():
        return Guessed("rad", "phases; taken as rad, since all are within a turn")
    span = f"phases from {phases.min():g} to {phases.max():g} without a unit"
    raise ValueError(f"{span}; the first line must name it, as in phase [rad] or phase [deg]")


def _from_ultraino(path: Path) -> torch.Tensor:
    file = read_ultraino(path)
    amplitudes = file.amplitudes
    if not amplitudes.any():
        if not file.phases.any():
            raise ValueError(f"{path}: all phases and amplitudes are 0; must be saved with a drive")
        warn_user(f"{path}: all amplitudes are 0, but not the phases; taken as 1")
        amplitudes = np.ones_like(amplitudes)
    return _of_arguments(path, file.phases, amplitudes)


def _of_arguments(path: Path, phases: Array, amplitudes: Array | float) -> torch.Tensor:
    """Return the drive of phases that are arg q; messages have them as the file does."""
    with within(path), warned_within(str(path)):
        return drive_from_phases(phases, amplitudes).conj().resolve_conj()


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
    columns["source_strength [Pa m]"] = strengths_of(array).numpy()
    columns["radius [m]"] = radii_of(array).numpy()
    if (offsets := phase_offsets_of(array)).any():
        columns[f"{OFFSET} [rad]"] = offsets.numpy()
    columns = _numbered(columns, drive)
    flat = drive.flatten()
    amplitudes = amplitudes_of(flat).clamp(max=1.0)  # rounding may exceed 1, which is refused when read
    columns |= {"phase [rad]": phases_of(flat).numpy(), "amplitude": amplitudes.numpy()}
    arrays = {"drive": drive.numpy(), "positions": positions, "normals": normals}
    arrays |= {name: np.asarray(getattr(array, name)) for name in SIZE_COLUMNS}
    return columns, arrays | {OFFSET: np.asarray(array.phase)}


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
        return device.drive(
            *(level.long() if torch.equal(level, level.round()) else level for level in levels)
        )
