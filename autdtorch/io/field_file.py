"""Fields on regular grids in files: VTK image data (.vti) for ParaView, and HDF5."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import torch

from autdtorch.utils.array_types import Array
from autdtorch.utils.files import path_of, replacing
from autdtorch.utils.validation import LENGTH_TOLERANCE, ArrayLike, complex_tensor, positive, real_tensor


class _Grid(NamedTuple):
    """A grid of points origin + i spacing[0] axes[0] + j spacing[1] axes[1] + k spacing[2] axes[2] [m]."""

    origin: Array  # (3,) of the first point
    spacing: Array  # (3,)
    axes: Array  # (3, 3), one a row, orthonormal


def save_field(
    path: str | os.PathLike[str], pressure: ArrayLike, points: ArrayLike, frequency: float
) -> None:
    """Write the complex pressure on a regular grid or plane of points.

    - `.vti`: VTK image data, for ParaView and PyVista. Point data pressure_real, pressure_imag and
      pressure_magnitude [Pa], field data frequency [Hz]; lengths in m. A tilted grid
      has a direction matrix (VTK 9 and later).
    - `.h5`, `.hdf5`: the dataset `pressure`, complex128. Attributes: units "Pa"; origin (3,), a point;
      spacing (n,) and axes (n, 3), unit vectors, of its n axes; length_units "m"; frequency;
      frequency_units "Hz"; time_convention "exp(-i omega t)".

    Args:
        path: of the file, which is replaced; the suffix decides the format.
        pressure: complex (Nx, Ny, Nz) or (Nu, Nv) [Pa], amplitudes for e^{-i w t}.
        points: (Nx, Ny, Nz, 3) as from `cell_centers`, or (Nu, Nv, 3) as from `Plane.points` [m].
        frequency: of the drive [Hz], > 0.

    Raises:
        ValueError: another suffix, shapes that do not agree, or points that are not a regular right-angled
            grid with at least two points along two axes.
    """
    path = path_of("path", path, suffixes=(".vti", ".h5", ".hdf5"))
    places = real_tensor("points", points, "m").detach().cpu().numpy()
    if places.ndim not in (3, 4) or places.shape[-1] != 3:
        raise ValueError(f"points: shape {places.shape}; must be (Nx, Ny, Nz, 3) or (Nu, Nv, 3)")
    values = complex_tensor("pressure", pressure).detach().cpu()
    if values.shape != places.shape[:-1]:
        raise ValueError(f"pressure: shape {tuple(values.shape)}; must be {places.shape[:-1]} as the points")
    frequency = positive("frequency", frequency, "Hz")
    grid = _grid(places)
    write = _write_vti if path.suffix.lower() == ".vti" else _write_hdf5
    with replacing(path) as partial:
        write(partial, values, grid, frequency)


def _grid(points: Array) -> _Grid:
    """Return the regular grid of `points` (Nx, Ny, Nz, 3) or (Nu, Nv, 3)."""
    shape = points.shape[:-1] + (1,) * (4 - points.ndim)
    points = points.reshape(*shape, 3)
    long = [axis for axis in range(3) if shape[axis] > 1]
    if len(long) < 2:
        raise ValueError(f"points: shape {points.shape}; must have two axes of at least 2 points")
    origin = points[0, 0, 0]
    steps = np.zeros((3, 3))
    for axis in long:
        steps[axis] = np.take(points, -1, axis)[0, 0] - origin
        steps[axis] /= shape[axis] - 1
    spacing = np.linalg.norm(steps, axis=1)
    if spacing[long].min() < LENGTH_TOLERANCE:
        raise ValueError("points: two coincide; must be a grid")
    if len(long) == 2:
        # The axis of one point: the normal, with any step > 0.
        (flat,) = {0, 1, 2} - set(long)
        spacing[flat] = spacing[long].min()
        steps[flat] = np.cross(steps[flat - 2], steps[flat - 1]) / spacing[long].max()
    axes = steps / spacing[:, None]
    index = np.moveaxis(np.indices(shape), 0, -1)
    off = np.abs(points - (origin + index @ steps)).max()
    if off > LENGTH_TOLERANCE or np.abs(axes @ axes.T - np.eye(3)).max() > 1e-6:
        raise ValueError("points: must be a regular grid with right angles, such as Plane.points")
    return _Grid(origin, spacing, axes)


def _write_hdf5(path: Path, pressure: torch.Tensor, grid: _Grid, frequency: float) -> None:
    with h5py.File(path, "w") as file:
        data = file.create_dataset("pressure", data=pressure.numpy(), compression="gzip", shuffle=True)
        axes = slice(pressure.ndim)
        places = {"origin": grid.origin, "spacing": grid.spacing[axes], "axes": grid.axes[axes]}
        units = {"units": "Pa", "length_units": "m", "frequency_units": "Hz"}
        wave = {"frequency": frequency, "time_convention": "exp(-i omega t)"}
        data.attrs.update(places | units | wave)


def _along_coordinates(pressure: Array, grid: _Grid) -> tuple[Array, _Grid]:
    """Reorder the field to axes along +x, +y and +z, if its axes are parallel to them."""
    nearest = np.abs(grid.axes).argmax(axis=1)
    if np.abs(grid.axes[range(3), nearest]).min() < 1 - 1e-12:
        return pressure, grid
    order = np.argsort(nearest)
    pressure, spacing = pressure.transpose(order), grid.spacing[order]
    origin = grid.origin.copy()
    for axis, sign in enumerate(np.sign(grid.axes[order, range(3)])):
        if sign < 0:
            pressure = np.flip(pressure, axis)
            origin[axis] -= spacing[axis] * (pressure.shape[axis] - 1)
    return pressure, _Grid(origin, spacing, np.eye(3))


def _write_vti(path: Path, pressure: torch.Tensor, grid: _Grid, frequency: float) -> None:
    # these load slowly
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    values = pressure.numpy().reshape(*pressure.shape, *(1,) * (3 - pressure.ndim))
    values, grid = _along_coordinates(values, grid)
    image = vtkImageData()
    image.SetDimensions(*values.shape)
    image.SetOrigin(*grid.origin)
    image.SetSpacing(*grid.spacing)
    image.SetDirectionMatrix(*grid.axes.T.ravel())  # the axes are its columns
    for name, part in (("real", values.real), ("imag", values.imag), ("magnitude", np.abs(values))):
        image.GetPointData().AddArray(_named(f"pressure_{name}", part.ravel(order="F")))
    image.GetPointData().SetActiveScalars("pressure_magnitude")
    image.GetFieldData().AddArray(_named("frequency", np.array([frequency])))
    writer = vtkXMLImageDataWriter()
    writer.SetInputData(image)
    writer.SetFileName(str(path))
    writer.SetHeaderTypeToUInt64()
    writer.SetCompressorTypeToNone()  # takes ten times as long
    writer.EncodeAppendedDataOff()
    if not writer.Write():
        raise OSError(errno.EIO, "VTK could not write it; is the disk full?")


def _named(name: str, values: Array) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk

    array = numpy_to_vtk(values, deep=True)  # type: ignore[no-untyped-call]
    array.SetName(name)
    return array
