"""The error of a grid, estimated from other grids and from the uncertain surfaces of bodies.

Chance decides which of two grids is nearer the truth. The estimate is the weighted geometric mean of the
errors that up to two other grids show and of the usual error of such a grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from autdtorch.fdtd.assembly.edges import sharp_sides
from autdtorch.fdtd.region import Body, Fluid, Region
from autdtorch.fdtd.steady_state import SILENCE
from autdtorch.utils.array_types import REAL, Array
from autdtorch.utils.spatial import places_along

_WEIGHT = 0.3  # of the logarithm of the usual error: grids may agree by chance
_MOST_ABOVE = 10.0  # Largest ratio of the error by grids and the usual one that counts, as at resonances
_LEAST = 0.37  # Least error that is claimed, relative to the usual one
_COMPARED = 2  # Last other grids that count: earlier ones may be too coarse for the scene
_BESIDE = 0.6  # Width of the strip along an edge that its errors are relative to [wavelengths]
_EQUAL = 0.28  # Spacing [wavelengths] at which the parts of second and sixth order are equal at cut faces
# The part of second order at edges of faces along the grid, relative to the part at cut faces. From 4 to 6.5
# cells per wavelength, errors of 26 scenes fell with the power of 3.6 in the median, in shadows of 5.
_ALONG = 0.4
# Error of points and sources on a surface, relative to the scattered field and the square of a cell in
# wavelengths. Kernels there see one side, and at edges the field varies faster than waves do. At 5 to 10
# cells per wavelength, 880 points within 0.7 cells of 22 rigid boxes err by more than three times their
# claims in 5 %, and without this in 18 %; of 320 points of other boxes 3 %, not 19 %.
_READING = 2.0
# Error beside edges relative to the field, `edge_errors`. Of 12 boxes and plates of 0.3 to 8 mm, on cells of
# 1 mm, 30 % of the points within two cells of an edge erred by more than three times their claims without
# this, and with it 1 %; the medians of error over claim are 2.1 and 0.9.
_AT_EDGES = 0.012
_EDGE_POWER = 2 / 3  # Power of the distance with which the pressure at a right edge of a rigid body varies
_SHARP_EDGE = 0.8  # Angle [rad] between the normals of faces that meet at a sharp edge, at least
_COVERED = 0.5  # Least contrast of a body, relative to another's, whose edges on it are not sharp
_EDGE_REACH = 0.5  # Distance from an edge that counts [wavelengths]
_LEAST_CELLS = 0.5  # Least distance from an edge [cells] that counts as such
_USUAL, _USUAL_CUT = 0.8, 2.1  # Usual error relative to `growth`: of faces along the grid, and of cut ones
_MOST_HELD = 5.0  # Largest ratio of densities of a fluid in a bore that counts: little enters denser ones
_LEAST_KINK = 0.3  # Least share of errors at surfaces that is due to kinks: waves in air have the rest
_TINY = torch.finfo(torch.float64).tiny


@dataclass(frozen=True)
class Law:
    """The growth of errors with the spacing, for a shortest wavelength [m].

    Surfaces have errors of second order, waves in air of sixth. Faces parallel to the grid are all but exact:
    there the former are those of edges, which are smaller, and count less on large bodies.

    Fitted to 152 claims for random scenes of 11 families (`scripts/shared/families.py` has their like) at
    tolerances of 1 to 5 %: 149 are within a factor of three, and the median is 1.15 times the error.
    """

    wavelength: float
    aligned: bool  # whether all faces are parallel to their grids
    air: float = math.inf  # wavelength around bodies [m]
    thickness: float = math.inf  # their mean thickness [m]
    kink: float = 1.0  # how much of what they scatter is due to kinks of the pressure; see `Region.kink`
    rigid: bool = False  # whether some of them are rigid
    held: float = 1.0  # ratio of densities of the air and a fluid in rigid bodies; see `Region.held_contrast`
    # length of their edges over their area [1/m], and the largest extent of one [m], for aligned faces alone
    edges: float = math.inf
    extent: float = math.inf

    @property
    def _at_surfaces(self) -> float:
        """Part of second order; along the grid by the share of the surface that is beside edges, about."""
        return _ALONG * min(_BESIDE * self.wavelength * self.edges, 1.0) if self.aligned else 1.0

    def usual(self, spacing: float) -> float:
        """Return the usual error of these scenes on cells of a spacing [m], relative to the scattered field.

        Faces that cut cells are off by a share of a cell, which counts relative to the size of a body: rigid
        spheres of 1 to 7 mm err in proportion to 1 / radius, as fluid ones do. Cells see nothing thinner.
        Without a kink of the pressure cut faces leave little; fluids in rigid bodies resonate and leave more.
        Aligned bodies of less than half a wavelength err as the square of a cell over their extent: 14 boxes
        of 0.07 to 0.25 wavelengths have errors of 0.15 to 2.6 times the usual ones.
        """
        growth = min(self.held, _MOST_HELD) * self.growth(spacing)
        if self.aligned:
            small = self.wavelength / (2 * max(self.extent, spacing))
            return _USUAL * max(small, 1.0) ** 2 * growth
        thin = self.wavelength**2 / (2 * self.air) / max(self.thickness, spacing)
        return _USUAL_CUT * max(self.kink, _LEAST_KINK) * max(thin, 1.0) * growth

    def growth(self, spacing: float) -> float:
        """Return the error of a spacing [m] relative to those of others."""
        share = spacing / self.wavelength
        return share**2 * (self._at_surfaces + (share / _EQUAL) ** 4)

    def ratio(self, other: float, spacing: float) -> float:
        """Return the error at another spacing [m] over the error at a spacing [m].

        Of rigid bodies that are thinner than a cell, cells see another thickness, which falls with the cells.
        """
        ratio = self.growth(other) / self.growth(spacing)
        if self.rigid and not self.aligned:
            ratio *= max(self.thickness, spacing) / max(self.thickness, other)
        return ratio

    def spacing_of(self, wanted: float) -> float:
        """Return the spacing [m] whose `growth` is `wanted`."""
        # the root of y^3 + 3 part^2 y = _EQUAL^4 wanted, where y is the square of the spacing
        part = _EQUAL**2 * math.sqrt(self._at_surfaces / 3)
        square = 2 * part * math.sinh(math.asinh(_EQUAL**4 * wanted / (2 * part**3)) / 3)
        return math.sqrt(square) * self.wavelength


def sizes(matrix: Tensor, free: Tensor) -> Tensor:
    """Return the norms (P,) of rows of a matrix (P, M), at least -80 dB of those in free space (P, M)."""
    return torch.maximum(matrix.norm(dim=1), SILENCE * free.norm(dim=1)).clamp(min=_TINY)


def grid_errors(
    matrix: Tensor, free: Tensor, spacing: float, others: Sequence[tuple[Tensor, float]], law: Law
) -> Tensor:
    """Return the estimated relative errors (P,) of the rows of a matrix (P, M) whose incident field is exact.

    `free` (P, M) is the matrix in free space. `others` are the matrices (P, M) on other grids and their
    spacings [m]; the last ones count.
    """
    by_grids = errors_by_grids(matrix, free, spacing, others, law)
    usual = usual_errors(matrix, free, spacing, law)
    near = torch.maximum(usual, by_grids / _MOST_ABOVE)
    return torch.maximum(by_grids ** (1 - _WEIGHT) * near**_WEIGHT, _LEAST * usual)


def usual_errors(matrix: Tensor, free: Tensor, spacing: float, law: Law) -> Tensor:
    """Return the usual relative errors (P,) of the rows of a matrix (P, M); see `Law.usual`."""
    errors: Tensor = (law.usual(spacing) * _scattered(matrix, free)).clamp(min=_TINY)
    return errors


def errors_by_grids(
    matrix: Tensor, free: Tensor, spacing: float, others: Sequence[tuple[Tensor, float]], law: Law
) -> Tensor:
    """Return the errors (P,) from other grids alone; see `grid_errors`."""
    size, compared = sizes(matrix, free), others[-_COMPARED:]
    changes = torch.stack([(other - matrix).norm(dim=1) / size for other, _ in compared], dim=1)
    grown = [abs(law.ratio(other, spacing) - 1) for _, other in compared]
    return (changes / torch.tensor(grown, **REAL)).clamp(min=_TINY).log().mean(dim=1).exp()


def shape_errors(matrix: Tensor, free: Tensor, region: Region) -> Tensor:
    """Return the relative errors (P,) of the rows of a matrix (P, M) due to uncertain surfaces of bodies.

    A surface off by a distance d turns the phase of what it scatters by up to 2 k d.
    """
    distance = max((body.uncertainty for body in region.bodies), default=0.0)
    errors: Tensor = 2 * region.wavenumber * distance * _scattered(matrix, free)
    return errors


def reading_errors(
    matrix: Tensor, free: Tensor, points: Tensor, nodes: Tensor, region: Region, spacing: float
) -> Tensor:
    """Return the relative errors (P,) of the rows of a matrix (P, M) due to kernels beside surfaces.

    The points (P, 3) [m] are read, and the monopoles (M, n, 3) [m] of the sources driven, on cells of a
    `spacing` [m]; from a cell away on, other errors are larger.
    """
    reading, driving = (
        np.clip(1 - np.abs(region.kinked.distance(places.numpy())) / spacing, 0, None)
        for places in (points, nodes)
    )
    on_surface = _READING * (spacing / region.wavelength) ** 2
    share = on_surface * torch.from_numpy(reading[:, None] + driving.mean(axis=1))
    errors: Tensor = _scattered_size(share * matrix, share * free) / sizes(matrix, free)
    return errors


def edge_errors(
    matrix: Tensor, free: Tensor, points: Tensor, nodes: Tensor, region: Region, spacing: float
) -> Tensor:
    """Return the relative errors (P,) of the rows of a matrix (P, M) due to sharp edges nearby.

    The points (P, 3) [m] are read, and the monopoles (M, n, 3) [m] of the sources driven, on cells h of a
    `spacing` [m]. The pressure varies as the power `_EDGE_POWER` of k times the distance r, and an error of
    second order as that times (h / r)^2.
    """
    reading, driving = (_edge_shares(places.numpy(), region, spacing) for places in (points, nodes))
    share = torch.from_numpy(reading[:, None] + driving.mean(axis=1))
    size = torch.minimum((share * matrix).norm(dim=1), (share * free).norm(dim=1))  # in shadows, the rest
    errors: Tensor = size / sizes(matrix, free)
    return errors


def _edge_shares(places: Array, region: Region, spacing: float) -> Array:
    """Return the errors (...) of places (..., 3) [m] by the edge that counts most, relative to the field."""
    shares, reach = np.zeros(places.shape[:-1]), _EDGE_REACH * region.wavelength

    def error_at(distance: Array) -> Array:
        cells = np.maximum(distance / spacing, _LEAST_CELLS)
        error: Array = (region.wavenumber * spacing) ** _EDGE_POWER * cells ** (_EDGE_POWER - 2)
        return error

    bodies = region.part(range(len(region.bodies)), range(len(region.mirrors))).bodies
    contrasts = [_contrast(body, region.fluid) for body in bodies]
    for body, contrast in zip(bodies, contrasts, strict=True):
        beyond = np.maximum(np.subtract(body.shape.lower, places), places - body.shape.upper).max(axis=-1)
        near = beyond < reach
        if not contrast or not near.any() or body.continued or body.uncertainty:
            continue  # edges of voxels are no edges
        covering = [
            other.shape
            for other, its in zip(bodies, contrasts, strict=True)
            if other is not body and its / contrast >= _COVERED
        ]
        ends = sharp_sides(body.shape, covering, _SHARP_EDGE)
        if len(ends):
            distance, _ = KDTree(places_along(ends, _LEAST_CELLS * spacing)).query(places[near])
            error = _AT_EDGES * np.clip(error_at(distance) - error_at(np.array(reach)), 0, None)
            shares[near] = np.maximum(shares[near], abs(contrast) * error)
    return shares


def _contrast(body: Body, air: Fluid) -> float:
    """Return the contrast of a body's density with the air's, 1 for rigid bodies, negative for light ones."""
    if body.fluid is None:
        return 1.0
    ratio = body.fluid.inertia / air.inertia
    return (ratio - 1) / (ratio + 1)


def rigid_errors(matrix: Tensor, free: Tensor, region: Region) -> Tensor:
    """Return the relative errors (P,) of the rows of a matrix (P, M) due to heavy bodies taken as rigid.

    The sound through them is known relative to what they scatter: in their shadow that is the field in free
    space (P, M), which it cancels, and a large part of what is left. Small bodies pass and scatter little.
    Elsewhere, 40 heavy balls of 0.4 to 12 mm claim 0.7 to 8 times the difference.
    """
    passing = math.hypot(*(body.rigid_error for body in region.bodies))
    errors: Tensor = passing * (matrix - free).norm(dim=1) / sizes(matrix, free)
    return errors


def _scattered(matrix: Tensor, free: Tensor) -> Tensor:
    """Return the share (P,) of the scattered field in rows of a matrix (P, M), at most 1."""
    share: Tensor = _scattered_size(matrix, free) / sizes(matrix, free)
    return share


def _scattered_size(matrix: Tensor, free: Tensor) -> Tensor:
    """Return the norms (P,) of the scattered field in rows of a matrix (P, M), at most those of the rows.

    In a shadow the rest of it cancels the field in free space (P, M), wherever the surface is.
    """
    return torch.minimum((matrix - free).norm(dim=1), matrix.norm(dim=1))
