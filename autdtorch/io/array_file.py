"""Transducer arrays from files: CSV, .npz, the board files of OpenMPD and the simulations of Ultraino."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from autdtorch.hardware.devices.openmpd import OpenMPDBoard
from autdtorch.io.csv_table import Guessed, read_rows, table_of
from autdtorch.io.ultraino_file import SUFFIX, read_ultraino
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import device_axes, in_plane
from autdtorch.utils.array_types import Array
from autdtorch.utils.files import path_of, read_arrays
from autdtorch.utils.spatial import closest_pair
from autdtorch.utils.validation import ArrayLike, within

# Columns of a CSV file with the positions of transducers and the directions of emission, and their units.
PLACE_COLUMNS = {"x": "m", "y": "m", "z": "m"}
NORMAL_COLUMNS = {"nx": "", "ny": "", "nz": ""}
SIZE_COLUMNS = {"source_strength": "Pa m", "radius": "m"}
OFFSET = "phase_offset"  # [rad] of the transducers; phases in these files belong to drives
_PARTS = ("positions", "normals", *SIZE_COLUMNS)
_IGNORED = {"frame": "", "transducer": "", "phase": "rad", "amplitude": ""}
_PITCHES = {"m": (3e-3, 0.1), "mm": (3.0, 100.0)}  # of arrays for airborne ultrasound, in each unit
_UNIT_ROUNDING = 1e-3  # by which the length of a normal may differ from 1, in a file of few digits


def load_array(
    path: str | os.PathLike[str],
    center: ArrayLike = (0.0, 0.0, 0.0),
    normal: ArrayLike = (0.0, 0.0, 1.0),
    angle: float = 0.0,
    source_strength: ArrayLike | None = None,
    radius: ArrayLike | None = None,
) -> TransducerArray:
    """Read an array from a file, and place it in the scene; by default, in the coordinates of the file.

    - `.csv`: columns `x [m]`, `y [m]`, `z [m]` (or `[mm]`, `[cm]`), and `nx`, `ny`, `nz` for the directions
      of emission, by default +z; optionally `source_strength [Pa m]`, `radius [m]` and `phase_offset [rad]`
      (or `[deg]`), the phase of `TransducerArray`. Names and units may be in a comment. Without names, the
      columns are x, y, z or x, y, z, nx, ny, nz, of length 1. A length's unit that is not stated is inferred
      from the distance of neighbours, with a `ScaleWarning`.
    - `.npz`: arrays `positions` (M, 3) [m] and `normals` (M, 3) or (3,), optionally `source_strength` [Pa m],
      `radius` [m] and `phase_offset` [rad], numbers or (M,).
    - `.pat`: a board of OpenMPD, emitting along +z; `OpenMPDBoard.load` also reads its calibration.
    - `.xml.gz` or `.xml`: a simulation of Ultraino, its transducers in the order of their numbers, with their
      powers and half their apertures as strengths and radii. Ultraino's y axis, which points up, becomes z.

    Files that `save_drive` writes without a device hold the array, too.

    Args:
        path: of the file; the suffix decides the format.
        center: position of the file's origin (3,) [m].
        normal: direction of its z axis (3,).
        angle: of its x axis from u towards v [rad], with (u, v) = `plane_basis(normal)`.
        source_strength: [Pa m], > 0, a number or (M,); None for the file's, or else its format's.
        radius: of the discs [m], 0 for points, a number or (M,); None for the file's, or else its format's.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, bad content, or a bad argument. The message names the file, and the line
            where it has lines.
    """
    kind = path_of("path", path, suffixes=tuple(_READERS)).suffix.lower()
    parts = _READERS[kind if kind != ".gz" else SUFFIX](path)
    chosen = {"source_strength": source_strength, "radius": radius}
    with within(path):
        file = TransducerArray(**{name: part for name, part in parts.items() if chosen.get(name) is None})
    sizes = {name: getattr(file, name) if value is None else value for name, value in chosen.items()}
    positions = in_plane(file.positions, center, normal, angle)
    return TransducerArray(positions, file.normals @ device_axes(normal, angle), **sizes, phase=file.phase)


def _from_pat(path: str | os.PathLike[str]) -> dict[str, Any]:
    board = OpenMPDBoard.load(path).array()
    return {name: getattr(board, name) for name in _PARTS}


def _from_csv(path: str | os.PathLike[str]) -> dict[str, Any]:
    known = PLACE_COLUMNS | NORMAL_COLUMNS | SIZE_COLUMNS | {OFFSET: "rad"} | _IGNORED
    table = table_of(read_rows(path), known, _array_columns, _length_unit)
    wanted = PLACE_COLUMNS | (NORMAL_COLUMNS if NORMAL_COLUMNS.keys() & table.keys() else {})
    if missing := [name for name in wanted if name not in table]:
        raise ValueError(f"{path}: no column {', '.join(missing)}; must have {', '.join(wanted)}")
    rows = table["frame"] == 0 if "frame" in table else slice(None)  # each frame repeats the array
    values = np.stack([table[name][rows] for name in wanted], axis=1)
    sizes = {name: table[name][rows] for name in SIZE_COLUMNS if name in table}
    return {
        "positions": values[:, :3],
        "normals": values[:, 3:] if len(wanted) > 3 else (0.0, 0.0, 1.0),
        **sizes,
        "phase": table[OFFSET][rows] if OFFSET in table else 0.0,
    }


def _array_columns(values: Array) -> list[str]:
    names = [*PLACE_COLUMNS, *NORMAL_COLUMNS]
    if values.shape[1] not in (3, 6):
        accepted = (
            f"must be 3 or 6 ({', '.join(names)}), or begin with a line of names such as x [mm],y [mm],z [mm]"
        )
        raise ValueError(f"{values.shape[1]} columns without names; {accepted}")
    lengths = np.linalg.norm(values[:, 3:], axis=1)
    if values.shape[1] == 6 and (wrong := np.abs(lengths - 1) > _UNIT_ROUNDING).any():
        length = (
            f"columns 4 to 6 without names, of length {lengths[wrong][0]:.4g} in row {wrong.argmax() + 1}"
        )
        fix = "write decimals with a point, or separate cells by semicolons, or name the columns"
        raise ValueError(f"{length}; must be normals of length 1: {fix}")
    return names[: values.shape[1]]


def _length_unit(kind: str, table: Mapping[str, Array]) -> Guessed | None:
    """Return the unit of lengths or strengths that state none: that in which the pitch is a usual one."""
    if OFFSET in table:
        raise ValueError(f"column {OFFSET} has no unit; must be {OFFSET} [rad] or {OFFSET} [deg]")
    if kind != "m":
        return Guessed(kind, "") if kind == "Pa m" else None
    why = ""
    if table.keys() >= PLACE_COLUMNS.keys() and len(table["x"]) > 1:
        places = torch.from_numpy(np.stack([table[name] for name in PLACE_COLUMNS], axis=1))
        pitch = closest_pair(places)[0]
        for unit, (least, most) in _PITCHES.items():
            if least <= pitch < most:
                return Guessed(
                    unit, f"length; taken as {unit}, since neighbours are {pitch:.4g} {unit} apart"
                )
        why = f", and neighbours {pitch:.4g} apart are no array of 3 to 100 mm in m or mm"
    columns = ", ".join(table)
    raise ValueError(f"columns {columns} have no unit{why}; the header must be as x [m] or x [mm] or x [cm]")


def _from_npz(path: str | os.PathLike[str]) -> dict[str, Any]:
    arrays = read_arrays(path)
    for name in ("positions", "normals"):
        if name not in arrays:
            raise ValueError(f"{path}: no array {name!r}; must have positions and normals")
    return {name: arrays[name] for name in _PARTS if name in arrays} | {"phase": arrays.get(OFFSET, 0.0)}


_READERS: dict[str, Callable[[str | os.PathLike[str]], dict[str, Any]]] = {
    ".csv": _from_csv,
    ".npz": _from_npz,
    ".pat": _from_pat,
    SUFFIX: lambda path: read_ultraino(path).parts,
    ".xml": lambda path: read_ultraino(path).parts,
}
