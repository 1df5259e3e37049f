"""Pictures of a thermal camera in files: plain NumPy arrays, single precision."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from autdtorch.hardware.camera.picture import Picture
from autdtorch.scene.drive import validate_single_drive
from autdtorch.scene.geometry import Plane
from autdtorch.utils.files import path_of, read_arrays, write_arrays
from autdtorch.utils.validation import ArrayLike, complex_tensor, real_tensor, require_kind, within

#: Folder of a trial for its pictures: `evaluation_00012.npz` of evaluation 12 (from 0), and `again_0.npz`,
#: `again_1.npz`, ... of the drive that the search found, when it was played again.
PICTURES = "pictures"
EVALUATION, AGAIN = "evaluation", "again"  # begin the names of these

_MAPS = ("pressure", "deviation")
_PLANE = ("center", "normal", "size")
_REST = ("relative", "frames", "latency")


def save_picture(path: str | os.PathLike[str], picture: Picture, drive: ArrayLike | None = None) -> None:
    """Write a picture of a thermal camera to a .npz file, its maps in single precision.

    Args:
        path: of the file, which is replaced.
        picture: the picture.
        drive: complex (M,), |q| <= 1, of the sound in the picture, which `load_drive` reads from the file.

    Raises:
        ValueError: another suffix, no picture, or no drive.
        OSError: the file cannot be written.
    """
    path = path_of("path", path, suffixes=(".npz",))
    require_kind("picture", picture, Picture)
    maps = {name: getattr(picture, name).numpy().astype(np.float32) for name in _MAPS}
    plane = {name: np.asarray(getattr(picture.plane, name)) for name in _PLANE}
    rest = {name: getattr(picture, name) for name in _REST}
    rest["doubts"] = np.asarray(picture.doubts, dtype=np.str_)
    if drive is not None:
        checked = complex_tensor("drive", drive)
        rest["drive"] = validate_single_drive(checked, checked.numel()).detach().cpu().numpy()
    write_arrays(path, maps | plane | rest)


def load_picture(path: str | os.PathLike[str]) -> Picture:
    """Read a picture that `save_picture` wrote; reading runs no code.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, or a file without a picture.
    """
    path = path_of("path", path, suffixes=(".npz",))
    arrays = read_arrays(path)
    with within(path):
        wanted = {*_MAPS, *_PLANE, *_REST, "doubts"}
        if missing := sorted(wanted - set(arrays)):
            raise ValueError(f"no array {missing[0]!r}; must be written by save_picture")
        pressure, deviation = (real_tensor(name, arrays[name], "Pa") for name in _MAPS)
        plane = Plane(*(arrays[name].tolist() for name in _PLANE))
        relative, frames, latency = (arrays[name].tolist() for name in _REST)
        require_kind("relative", relative, bool)
        doubts = tuple(map(str, arrays["doubts"].ravel()))
        return Picture(plane, pressure, deviation, relative, frames, latency, doubts)


def pictures_of_evaluations(folder: Path) -> list[Path]:
    """Return the pictures of a trial's evaluations in a folder, in their order."""
    return sorted(folder.glob(f"{EVALUATION}_*.npz"))


def newest_picture(folder: Path) -> Path | None:
    """Return the picture of a folder that was written last; None if there is none yet."""
    times = {}
    for path in folder.glob("*.npz"):
        try:
            times[path] = path.stat().st_mtime_ns
        except OSError:  # removed meanwhile
            continue
    return max(times, key=lambda path: (times[path], path.name), default=None)
