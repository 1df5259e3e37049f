"""The pictures of a trial's camera for a live view, beside the simulated plane."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import torch

from autdtorch.hardware.camera.picture import Picture
from autdtorch.io.drive_file import load_drive
from autdtorch.io.picture_file import PICTURES, load_picture, newest_picture
from autdtorch.plot.explore.calculation import Result
from autdtorch.plot.plane_maps import camera_figure
from autdtorch.scene.geometry import cell_centers_of
from autdtorch.utils.array_types import Array


class TrialPictures:
    """The newest picture in the folder of a trial, which may be running."""

    def __init__(self, trial: Path) -> None:
        """Look for pictures in the folder of a `trial`; nothing is read yet."""
        self._folder = trial / PICTURES
        self._file: Path | None = None
        self._time = 0  # of the file
        self._picture: Picture | None = None
        self._shown: Array | None = None  # field beside it

    def look(self) -> torch.Tensor | None:
        """Read the newest picture if it is new; return its drive (M,), None without one.

        Raises:
            ValueError: the file holds no picture, or no drive.
            OSError: it cannot be read.
        """
        file = newest_picture(self._folder)
        if file is None or (file, time := file.stat().st_mtime_ns) == (self._file, self._time):
            return None
        self._file, self._time = file, time  # a damaged file is named once
        drive = load_drive(file)
        self._picture, self._shown = load_picture(file), None
        return drive

    def state(self, result: Result) -> dict[str, Any]:
        """Return the state of the page that shows the picture beside a result; nothing if it shows them."""
        picture, field = self._picture, result.field
        if picture is None or self._file is None or self._shown is field:
            return {}
        self._shown = field
        sheet, simulated = result.request.situation.sheet, np.abs(field)
        text = f"{self._file.name}: {picture!r}"
        try:
            points = cell_centers_of(sheet, (simulated.shape[0], simulated.shape[1])).reshape(-1, 3)
            measured = picture.at(points)[0].numpy().reshape(simulated.shape)
        except ValueError:
            text += ". Show the plane of the camera to compare."
        else:
            seen = np.isfinite(simulated)
            factor = float((measured * simulated)[seen].sum()) / (
                float(np.square(simulated[seen]).sum()) or 1.0
            )
            simulated = factor * simulated
            off = np.linalg.norm((measured - simulated)[seen]) / (np.linalg.norm(measured[seen]) or 1.0)
            text += f". The simulation times {factor:.3g} differs by {100 * off:.2g} % (rms)."
        text = " ".join([text, *(f"{doubt}." for doubt in picture.doubts)])
        figure = camera_figure(picture, simulated, sheet, result.request.situation.scene)
        figure.savefig(png := io.BytesIO())
        return {
            "camera": f"data:image/png;base64,{base64.b64encode(png.getvalue()).decode('ascii')}",
            "camera_text": text,
        }
