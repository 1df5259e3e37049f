"""The plane of a camera in the report of a trial: as measured, beside the simulated one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from autdtorch.hardware.camera.picture import Picture
from autdtorch.io.picture_file import AGAIN, PICTURES, load_picture
from autdtorch.objectives.metrics import focus_metrics
from autdtorch.objectives.readings import deviation_by_square, deviation_of_square
from autdtorch.plot.camera_figure import camera_figure
from autdtorch.plot.data import outside_on_plane
from autdtorch.propagators import Propagator
from autdtorch.scene.geometry import cell_centers_of
from autdtorch.scene.scene import Scene
from autdtorch.study.report import alt_texts
from autdtorch.study.report.document import picture
from autdtorch.utils.files import naming
from autdtorch.utils.text import in_digits

_FIGURE = "plane.png"


def measured_plane(
    folder: Path, propagator: Propagator, drive: torch.Tensor, scale: float, names: Sequence[str]
) -> dict[str, Any]:
    """Draw the plane that a camera saw, and return its values for the report; none without pictures.

    Args:
        folder: of the trial, with the pictures of its drive; the figure goes there.
        propagator: the simulation of the bench.
        drive: the drive (M,) of the pictures.
        scale: factor from simulated to measured pressures.
        names: of the control points.
    """
    files = sorted((folder / PICTURES).glob(f"{AGAIN}_*.npz"))
    if not files:
        return {"plane": None}
    scene = propagator.scene
    measured = _mean([load_picture(file) for file in files])
    plane, counts = measured.plane, (measured.pressure.shape[0], measured.pressure.shape[1])
    field = scale * propagator.field(drive, cell_centers_of(plane, counts)).abs()
    simulated = Picture(plane, field, torch.zeros_like(field))
    with naming(folder / _FIGURE):
        camera_figure(measured, field.numpy(), plane, scene).savefig(folder / _FIGURE)
    air = torch.from_numpy(
        outside_on_plane(field.numpy(), plane, scene.obstacles, scene.reflectors)
    ).isfinite()
    size = measured.pressure[air].square().mean().sqrt()
    return {
        "plane": picture(_FIGURE, alt_texts.of_measured(measured.pressure, field)),
        "off": float((measured.pressure - field)[air].square().mean().sqrt() / size),
        "noise": float(measured.deviation[air].square().mean().sqrt() / size),
        "pictures": len(files),
        "relative": measured.relative,
        "areas": [_area(one, scene) for one in (measured, simulated)],
        "foci": _foci(scene, names, measured, simulated),
        "doubts": measured.doubts,
    }


def _mean(pictures: Sequence[Picture]) -> Picture:
    """Return the picture of the mean |p|^2, with the deviation of this mean."""
    first, square = pictures[0], torch.stack([one.pressure.square() for one in pictures])
    of_square = torch.stack([deviation_of_square(one.pressure, one.deviation) for one in pictures])
    mean = square.mean(dim=0)
    spread = of_square.square().mean(dim=0).sqrt() / len(pictures) ** 0.5
    doubts = dict.fromkeys(doubt for one in pictures for doubt in one.doubts)
    frames = sum(one.frames for one in pictures)
    pressure = mean.sqrt()
    deviation = deviation_by_square(pressure, spread)
    return Picture(first.plane, pressure, deviation, first.relative, frames, first.latency, tuple(doubts))


def _area(shown: Picture, scene: Scene) -> float:
    """Return the area per focus [m^2] (Fig. 3b)."""
    area = focus_metrics(shown.at(scene.control_points)[0], shown.pressure, shown.cell_area).area
    assert area is not None
    return float(area)


def _foci(scene: Scene, names: Sequence[str], measured: Picture, simulated: Picture) -> list[list[str]]:
    """Return a table of the maxima near the control points: distances [mm], and pressures [Pa]."""
    points = scene.control_points
    apart = torch.pdist(points).min() / 2 if len(points) > 1 else torch.inf
    radius = min(scene.wavelength, float(apart))
    places = [one.foci(points, radius) for one in (measured, simulated)]
    columns = [
        1e3 * (one - other).norm(dim=1) for one, other in ((places[0], places[1]), (places[1], points))
    ]
    columns += [one.at(place)[0] for one, place in zip((measured, simulated), places, strict=True)]
    head = ["from the simulated [mm]", "simulated, from the point [mm]", "measured [Pa]", "simulated [Pa]"]
    rows = [
        [name, f"{apart:.2f}", f"{off:.2f}", in_digits(one, 4), in_digits(other, 4)]
        for name, apart, off, one, other in zip(names, *(one.tolist() for one in columns), strict=True)
    ]
    return [["control point [mm]", *head], *rows]
