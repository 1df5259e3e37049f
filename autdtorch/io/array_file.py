"""Transducer arrays from files: CSV, .npz and the board files of OpenMPD."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from autdtorch.hardware.devices.openmpd_board import OpenMPDBoard
from autdtorch.io.csv_table import read_table
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import device_axes, in_plane
from autdtorch.utils.numpy_file import read_arrays
from autdtorch.utils.validation import ArrayLike, path_of, within

# Columns of a CSV file with the positions of transducers and the directions of emission, and their units.
PLACE_COLUMNS = {"x": "m", "y": "m", "z": "m"}
NORMAL_COLUMNS = {"nx": "", "ny": "", "nz": ""}
_IGNORED = {"frame": "", "transducer": "", "phase": "rad", "amplitude": ""}


def load_array(
    path: str | os.PathLike[str],
    center: ArrayLike = (0.0, 0.0, 0.0),
    normal: ArrayLike = (0.0, 0.0, 1.0),
    angle: float = 0.0,
    source_strength: float | None = None,
    radius: float | None = None,
) -> TransducerArray:
    """Read an array from a file, and place it in the scene; by default, in the coordinates of the file.

    - `.csv`: columns `x [m]`, `y [m]`, `z [m]` (or `[mm]`), and `nx`, `ny`, `nz` for the directions of
      emission, by default +z.
    - `.npz`: arrays `positions` (M, 3) [m] and `normals` (M, 3) or (3,), optionally the numbers
      `source_strength` [Pa m] and `radius` [m].
    - `.pat`: a board of OpenMPD, emitting along +z; `OpenMPDBoard.load` also reads its calibration.

    Files that `save_drive` writes without a device hold the array, too.

    Args:
        path: of the file; the suffix decides the format.
        center: position of the file's origin (3,) [m].
        normal: direction of its z axis (3,).
        angle: of its x axis from u towards v [rad], with (u, v) = `plane_basis(normal)`.
        source_strength: [Pa m], > 0; None for the value in the file, or else the default of its format.
        radius: of the discs [m], 0 for points; None for the value in the file, or the default of its format.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, bad content, or a bad argument. The message names the file, and the line
            where it has lines.
    """
    kind = path_of("path", path, suffixes=(".csv", ".npz", ".pat")).suffix.lower()
    if kind == ".pat":
        file = OpenMPDBoard.load(path).array()
    else:
        parts = _from_csv(path) if kind == ".csv" else _from_npz(path)
        with within(path):
            file = TransducerArray(**parts)
    return TransducerArray(
        in_plane(file.positions, center, normal, angle),
        file.normals @ device_axes(normal, angle),
        file.source_strength if source_strength is None else source_strength,
        file.radius if radius is None else radius,
    )


def _from_csv(path: str | os.PathLike[str]) -> dict[str, Any]:
    table = read_table(path, PLACE_COLUMNS | NORMAL_COLUMNS | _IGNORED)
    wanted = PLACE_COLUMNS | (NORMAL_COLUMNS if NORMAL_COLUMNS.keys() & table.keys() else {})
    if missing := [name for name in wanted if name not in table]:
        raise ValueError(f"{path}: no column {', '.join(missing)}; must have {', '.join(wanted)}")
    rows = table["frame"] == 0 if "frame" in table else slice(None)  # each frame repeats the array
    values = np.stack([table[name][rows] for name in wanted], axis=1)
    return {"positions": values[:, :3], "normals": values[:, 3:] if len(wanted) > 3 else (0.0, 0.0, 1.0)}


def _from_npz(path: str | os.PathLike[str]) -> dict[str, Any]:
    arrays = read_arrays(path)
    for name in ("positions", "normals"):
        if name not in arrays:
            raise ValueError(f"{path}: no array {name!r}; must have positions and normals")
    names = ("positions", "normals", "source_strength", "radius")
    return {name: arrays[name] for name in names if name in arrays}
