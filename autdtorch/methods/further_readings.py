"""Readings of drives that a method did not ask for, and the asked drives that others answer."""

from __future__ import annotations

import torch

from autdtorch.objectives.readings import Readings
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import invalid, require_kind

LOUDEST = 1e9
"""Largest pressure [Pa] that is no error of a program; air has 1e5 Pa."""

_PLACE = 1e-4  # m, distance of points that are the same; an 85th of a wavelength at 40 kHz
_EQUAL = 1e-10  # relative square distance of equal drives, in files with five digits
_DEPENDENT = 1e-6  # relative singular value below which drives are combinations of others
_NEAR = 0.05  # of an asked drive and of what a device plays for it: rounding to 6 phases or more leaves less


def fitting(
    readings: Readings, scene: Scene | None, transducers: int, foci: int, where: str = "readings."
) -> Readings:
    """Return readings of the control points alone, a column for each, after checking them.

    Args:
        readings: of the control points in their order, or of points that are control points; those of the
            other control points become gaps.
        scene: has the control points; None if nothing is known of them.
        transducers: number M.
        foci: number P of control points.
        where: name of the readings in messages, with its dot.
    """
    require_kind("readings", readings, Readings)
    if readings.drives.shape[1] != transducers:
        accepted = f"must be (N, {transducers}), as the array has transducers"
        raise ValueError(f"{where}drives: shape {tuple(readings.drives.shape)}; {accepted}")
    if len(loud := (readings.pressure > LOUDEST).nonzero()):
        place = loud[0].tolist()
        accepted = f"must be a magnitude up to {LOUDEST:g}, not a level in dB"
        raise invalid(f"{where}pressure{place}", float(readings.pressure[tuple(place)]), accepted, "Pa")
    if readings.points is not None:
        if scene is not None and len(scene.control_points) != foci:
            accepted = "must be None, with a column for each point of each scene: a place is in all scenes"
            raise ValueError(f"{where}points: shape {tuple(readings.points.shape)}; {accepted}")
        return _in_order(readings, readings.points, scene)
    if readings.pressure.shape[1] != foci:
        accepted = f"must be (N, {foci}), a column for each control point, or the readings have points"
        raise ValueError(f"{where}pressure: shape {tuple(readings.pressure.shape)}; {accepted}")
    return readings


def _in_order(readings: Readings, points: torch.Tensor, scene: Scene | None) -> Readings:
    """Return the readings of points (Q, 3) as columns of the control points, gaps where there are none."""
    if scene is None:
        accepted = "must be None, for the control points in their order: the problem has no scene"
        raise invalid("readings.points", tuple(points.shape), accepted, "m")
    control_points = scene.control_points.cpu()
    distance, column = torch.cdist(points, control_points).min(dim=1)
    if distance.max() > _PLACE:
        at = int(distance.argmax())
        accepted = f"must be a control point of the scene, to {_PLACE:g} m: methods read no others"
        raise invalid(f"readings.points[{at}]", points[at].tolist(), accepted, "m")
    if len(set(column.tolist())) < len(column):
        raise invalid("readings.points", column.tolist(), "must be another control point each")
    shape = len(readings), len(control_points)
    parts = {"pressure": readings.pressure, "phase": readings.phase, "deviation": readings.deviation}
    columns = {
        name: None if part is None else torch.full(shape, torch.nan, **REAL).index_copy(1, column, part)
        for name, part in parts.items()
    }
    return Readings(readings.drives, points=None, **columns)  # type: ignore[arg-type]


def joined(before: Readings | None, more: Readings) -> Readings:
    """Return all magnitudes of the control points, in order."""
    if before is None:
        return more
    drives = torch.cat([before.drives, more.drives])
    return Readings(drives, torch.cat([before.pressure, more.pressure]))


def answered(asked: torch.Tensor, drives: torch.Tensor) -> list[int | None]:
    """Return for each of drives (N, M) the index of the asked drive (B, M) that it answers, if any.

    It answers the nearest of those that it equals up to a common phase, which changes no magnitude. As many
    drives as were asked may each be what a device played for the asked one in its place, too.
    """
    power = drives.abs().square().sum(dim=1)[:, None] + asked.abs().square().sum(dim=1)
    distance = (1 - 2 * (drives @ asked.mH).abs() / power).masked_fill(power == 0, 0)
    in_place: list[bool] = (distance.diagonal() <= _NEAR).tolist() if len(drives) == len(asked) else []
    free = torch.ones(len(asked), dtype=torch.bool, device="cpu")
    places: list[int | None] = []
    for drive, away in zip(drives, distance, strict=True):
        exact = (asked == drive).all(dim=1)  # distinguishes asked drives that differ by rounding
        candidates = free & (exact if (free & exact).any() else away <= _EQUAL)
        nearest = away.masked_fill(~candidates, torch.inf).argmin() if candidates.any() else None
        places.append(None if nearest is None else int(nearest))
        free[[] if nearest is None else nearest] = False
    for row, near in enumerate(in_place):
        if near and places[row] is None and free[row]:
            places[row] = row
    return places


def independent_readings(drives: torch.Tensor) -> int:
    """Return how many of drives (N, M) show something new of a row of the transfer matrix, at most 4 M.

    A magnitude |g . q| depends on g by the matrix q q^H alone. Drives that repeat count once; drives that
    differ in few phases show less than random ones.
    """
    count = drives.shape[1]
    generator = torch.Generator("cpu").manual_seed(0)
    probes = torch.randn(4 * count, count, dtype=torch.complex128, generator=generator, device="cpu")
    return int(torch.linalg.matrix_rank((drives @ probes.mH).abs().square(), rtol=_DEPENDENT))
