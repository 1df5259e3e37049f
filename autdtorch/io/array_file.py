"""Transducer arrays from files: CSV, .npz and the board files of OpenMPD."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from autdtorch.hardware.devices.openmpd_board import OpenMPDBoard
from autdtorch.io.csv_table import read_table
from autdtorch.scene.arrays import PAPER_SOURCE_STRENGTH, TransducerArray
from autdtorch.scene.geometry import device_axes, in_plane
from autdtorch.utils.numpy_file import read_arrays
from autdtorch.utils.validation import ArrayLike, invalid, path_of, points_tensor, real_tensor, within

PLACE_COLUMNS = {"x": "m", "y": "m", "z": "m"}
"""Columns of a CSV file with the positions of transducers, and their units."""
NORMAL_COLUMNS = {"nx": "", "ny": "", "nz": ""}
"""Columns with the directions of emission."""
_IGNORED = {"transducer": "", "phase": "rad", "amplitude": ""}


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
    kind = path_of("path", path).suffix.lower()
    if kind == ".pat":
        file = OpenMPDBoard.load(path).array()
    elif kind == ".csv":
        file = _from_csv(path)
    elif kind == ".npz":
        file = _from_npz(path)
    else:
        raise invalid("path", str(path), "must end in .csv, .npz or .pat")
    return TransducerArray(
        in_plane(file.positions, center, normal, angle),
        file.normals @ device_axes(normal, angle),
        file.source_strength if source_strength is None else source_strength,
        file.radius if radius is None else radius,
    )


def _from_csv(path: str | os.PathLike[str]) -> TransducerArray:
    table = read_table(path, PLACE_COLUMNS | NORMAL_COLUMNS | _IGNORED)
    for wanted in (PLACE_COLUMNS, NORMAL_COLUMNS):
        missing = [name for name in wanted if name not in table]
        if missing and (wanted is PLACE_COLUMNS or len(missing) < 3):
            raise ValueError(f"{path}: no column {', '.join(missing)}; must have {', '.join(wanted)}")
    positions = np.stack([table[name] for name in PLACE_COLUMNS], axis=1)
    normals: Any = (0.0, 0.0, 1.0)
    if "nx" in table:
        normals = np.stack([table[name] for name in NORMAL_COLUMNS], axis=1)
    return _built(path, positions, normals)


def _from_npz(path: str | os.PathLike[str]) -> TransducerArray:
    arrays = read_arrays(path)
    for name in ("positions", "normals"):
        if name not in arrays:
            raise ValueError(f"{path}: no array {name!r}; must have positions and normals")
    strength = arrays.get("source_strength", np.array(PAPER_SOURCE_STRENGTH))
    radius = arrays.get("radius", np.array(0.0))
    return _built(path, arrays["positions"], arrays["normals"], strength, radius)


def _built(
    path: str | os.PathLike[str],
    positions: ArrayLike,
    normals: ArrayLike,
    source_strength: Any = PAPER_SOURCE_STRENGTH,
    radius: Any = None,
) -> TransducerArray:
    with within(path):
        places, directions = points_tensor("positions", positions), real_tensor("normals", normals)
        return TransducerArray(places, directions, source_strength, radius)
