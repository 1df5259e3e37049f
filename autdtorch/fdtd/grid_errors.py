"""The error of a grid, estimated from other grids and from the uncertain surfaces of bodies.

Chance decides which of two grids is nearer the truth. The estimate is the geometric mean of the errors that
up to two other grids show and of the usual error of such a grid. Faces parallel to the
grid are placed alike on all, and three grids show the order of their errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from autdtorch.fdtd.region import Region
from autdtorch.fdtd.steady_state import SILENCE
from autdtorch.utils.array_types import REAL

_WEIGHT = 0.2  # of the logarithm of the usual error: grids may agree by chance
_MOST_APART = 10.0  # Largest ratio of the two errors: a usual error farther away is moved to this ratio
_LEAST = 0.37  # Least error that is claimed, relative to the usual one
_COMPARED = 2  # Last other grids that count: earlier ones may be too coarse for the scene
_BESIDE = 0.6  # Width of the strip along an edge that its errors are relative to [wavelengths]
_ORDERS = 2.0, 4.0  # Least and largest order that three grids may show: those of the scheme's parts
_TINY = torch.finfo(torch.float64).tiny


@dataclass(frozen=True)
class Law:
    """The growth of errors with the spacing, for a shortest wavelength [m].

    At faces parallel to the grid the stencil's error, of fourth order, dominates. Where faces cut cells, the
    part of second order is larger.
    """

    wavelength: float
    aligned: bool  # whether all faces are parallel to their grids
    air: float = math.inf  # wavelength around bodies [m]
    thickness: float = math.inf  # their mean thickness [m]
    edges: float = math.inf  # length of their edges over their area [1/m], for aligned faces alone

    @property
    def _equal(self) -> float:
        """Spacing [wavelengths] at which the parts of second and fourth order are equal.

        Fitted to 165 scenes of eleven kinds on grids of 4 to 16 cells per wavelength; of aligned faces, to 50
        scenes of five kinds on spacings that fit them (0.17 where these were chosen alike for all).
        """
        return 0.12 if self.aligned else 0.4

    @property
    def at_edges(self) -> float:
        """Share of the scattered field that edges diffract, about; 1 where their length is not known.

        Faces parallel to the grid are all but exact, edges are not. In deep shadow their field is the only
        one. Errors of 28 random scenes of rigid plates, slits, corners, cubes and boxes of 1 to 47
        wavelengths are 0.2 to 1.8 times the usual ones; without this share they were 0.05 to 1.8 times.
        """
        return min(_BESIDE * self.wavelength * self.edges, 1.0)

    def usual(self, spacing: float) -> float:
        """Return the median error of these scenes on cells of a spacing [m], relative to the scattered field.

        Of aligned faces it is relative to the part that edges diffract. Faces that cut cells are off by a
        share of a cell, which counts relative to the size of a body: rigid spheres of 1 to 7 mm err in
        proportion to 1 / radius, as fluid ones do. Cells see nothing thinner.
        """
        if self.aligned:
            return 0.36 * self.growth(spacing)
        thin = self.wavelength**2 / (2 * self.air) / max(self.thickness, spacing)
        return 1.3 * max(thin, 1.0) * self.growth(spacing)

    def growth(self, spacing: float) -> float:
        """Return the error of a spacing [m] relative to those of others."""
        share = spacing / self.wavelength
        return share**2 * (1 + (share / self._equal) ** 2)

    def spacing_of(self, wanted: float) -> float:
        """Return the spacing [m] whose `growth` is `wanted`."""
        square = (math.sqrt(1 + 4 * wanted / self._equal**2) - 1) / 2
        return self._equal * math.sqrt(square) * self.wavelength


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
    usual = law.usual(spacing) * _scattered(matrix, free, law.at_edges)
    near = torch.minimum(torch.maximum(usual, by_grids / _MOST_APART), by_grids * _MOST_APART)
    return torch.maximum(by_grids ** (1 - _WEIGHT) * near**_WEIGHT, _LEAST * usual)


def errors_by_grids(
    matrix: Tensor, free: Tensor, spacing: float, others: Sequence[tuple[Tensor, float]], law: Law
) -> Tensor:
    """Return the errors (P,) from other grids alone; see `grid_errors`."""
    size, compared = sizes(matrix, free), others[-_COMPARED:]
    spacings = [spacing, *(each for _, each in compared)]
    changes = [(coarse - matrix).norm(dim=1) / size for coarse, _ in compared]
    growth = torch.tensor([law.growth(each) for each in spacings], **REAL).expand(len(size), -1)
    if law.aligned and len(compared) > 1:
        change = (compared[0][0] - compared[1][0]).norm(dim=1) / size
        growth = torch.tensor(spacings, **REAL) ** _order(change, changes[1], *spacings)[:, None]
    grown = (growth[:, 1:] / growth[:, :1] - 1).abs()
    return (torch.stack(changes, dim=1) / grown).clamp(min=_TINY).log().mean(dim=1).exp()


def _order(change: Tensor, later: Tensor, finest: float, coarsest: float, middle: float) -> Tensor:
    """Return the order (P,) of errors that two successive changes (P,) on three grids show."""
    orders = torch.linspace(*_ORDERS, 41, **REAL)
    fine, coarse, between = (spacing**orders for spacing in (finest, coarsest, middle))
    place = torch.searchsorted((coarse - between) / (between - fine), change / later.clamp(min=_TINY))
    return orders[place.clamp(max=len(orders) - 1)]


def shape_errors(matrix: Tensor, free: Tensor, region: Region) -> Tensor:
    """Return the relative errors (P,) of the rows of a matrix (P, M) due to uncertain surfaces of bodies.

    A surface off by a distance d turns the phase of what it scatters by up to 2 k d.
    """
    distance = max((body.uncertainty for body in region.bodies), default=0.0)
    errors: Tensor = 2 * region.wavenumber * distance * _scattered(matrix, free)
    return errors


def rigid_errors(matrix: Tensor, free: Tensor, region: Region) -> Tensor:
    """Return the relative errors (P,) of the rows of a matrix (P, M) due to heavy bodies taken as rigid.

    The sound through them is known relative to the field in free space (P, M). In their shadow it is a large
    part of the field.
    """
    passing = math.hypot(*(body.rigid_error for body in region.bodies))
    errors: Tensor = passing * free.norm(dim=1) / sizes(matrix, free)
    return errors


def _scattered(matrix: Tensor, free: Tensor, part: float = 1.0) -> Tensor:
    """Return the share (P,) of a part of the scattered field in rows of a matrix (P, M), at most 1.

    In a shadow the rest of it cancels the field in free space (P, M), wherever the surface is.
    """
    scattered = torch.minimum(part * (matrix - free).norm(dim=1), matrix.norm(dim=1))
    share: Tensor = scattered / sizes(matrix, free)
    return share
