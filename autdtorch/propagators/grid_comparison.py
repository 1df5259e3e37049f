"""The errors of a simulated transfer matrix, as those on other grids tell them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import mean

import torch

from autdtorch.fdtd.grid_errors import (
    edge_errors,
    errors_by_grids,
    grid_errors,
    reading_errors,
    rigid_errors,
    shape_errors,
    sizes,
    usual_errors,
)
from autdtorch.fdtd.resonances import displacement_error
from autdtorch.propagators.free_space import free_space_matrix
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.simulation import PressureMap
from autdtorch.utils.process import cached_property, one_library_thread

_RIGID_SHARE = 0.3
"""Error of bodies taken as rigid, relative to a tolerance, from which their materials count."""
_TINY = torch.finfo(torch.float64).tiny
_LONGER = 1.5
"""Ratio of periods from which another grid is next to a resonance that this one is not, and is left out."""


@dataclass(frozen=True, eq=False)
class GridComparison:
    """The transfer matrix of points by a plan, and those on other grids that tell its errors.

    Attributes:
        plan: the plan.
        points: (P, 3) [m].
        result: their transfer matrix.
        others: those on other grids, each with its spacing [m].
        missed: mask (P,) of the points that are silent only because cells close a gap; see `_errors`.
    """

    plan: Plan
    points: torch.Tensor
    result: PressureMap
    others: Sequence[tuple[PressureMap, float]]
    missed: torch.Tensor

    @cached_property
    def free(self) -> torch.Tensor:
        """The transfer matrix (P, M) [Pa] in free space."""
        scene = self.plan.scene
        return free_space_matrix(self.points, scene.array, scene.complex_wavenumber, scene.images)

    @property
    @one_library_thread()
    def error(self) -> float:
        """The estimated relative error of the whole matrix; infinite without other grids."""
        if not self.others:
            return math.inf
        return math.hypot(float(self._errors(_as_row)) + self._near_error, self._settling_error)

    @property
    @one_library_thread()
    def point_errors(self) -> torch.Tensor:
        """The estimated relative error of each point's row of the matrix, float64 (P,).

        Settling and resonances leave a mean error at quiet points, and one in proportion to loud ones.
        """
        size, heard = sizes(self.result.matrix, self.free), self.result.matrix.any(dim=1)
        usual = (size * heard).norm() / heard.sum().clamp(min=1).sqrt()
        settling = torch.where(heard, self._settling_error * (usual / size).clamp(min=1), 0.0)
        return torch.hypot(self._errors(lambda rows: rows) + self._near_errors, settling)

    @property
    @one_library_thread()
    def lasting_errors(self) -> tuple[float, float]:
        """The parts of the error that no grid lowers: by uncertain surfaces, and by bodies taken as rigid."""
        shape, rigid = (of(*self._whole, self.plan.region) for of in (shape_errors, rigid_errors))
        return float(shape), float(rigid)

    def needs_materials(self, tolerance: float) -> bool:
        """Return whether bodies taken as rigid leave an error that counts for a tolerance."""
        return self.lasting_errors[1] > _RIGID_SHARE * tolerance

    @property
    @one_library_thread()
    def resonance_error(self) -> float:
        """The error by shifted resonances, relative to the norm of what is scattered."""
        matrix = self.result.matrix
        return float(self._of_resonances * matrix.norm() / (matrix - self.free).norm().clamp(min=_TINY))

    @property
    @one_library_thread()
    def usual_error(self) -> float:
        """The usual error of grids of this spacing, without any other."""
        return float(usual_errors(*self._whole, self.plan.spacing, self.plan.law)) + self._near_error

    @property
    def ringing(self) -> float | None:
        """Periods of a run relative to the fewest, in the mean; None without a run in a single grid."""
        runs, grids = self.result.runs, self.plan.grouping.grids
        return mean(run.periods for run in runs) / grids[0].periods if runs and len(grids) == 1 else None

    @property
    def _whole(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The matrix and that in free space, each as one row (1, P M)."""
        return _as_row(self.result.matrix), _as_row(self.free)

    @property
    def _settling_error(self) -> float:
        """The error relative to the norm of the whole: of the steady state, and by shifted resonances."""
        return math.hypot(self.result.residual, self._of_resonances) if self.others else self.result.residual

    @property
    def _of_resonances(self) -> float:
        """The error by shifted resonances, relative to the norm of the whole."""
        other, spacing = self.others[-1]
        ratio, share = spacing / self.plan.spacing, self.plan.spacing / self.plan.law.wavelength
        matrix = self.result.matrix
        change = float((matrix - other.matrix).norm() / matrix.norm().clamp(min=_TINY))
        return displacement_error(self.result.resonances, other.resonances, ratio, share, change)

    @property
    def _near_error(self) -> float:
        """The error of the whole matrix beside surfaces and edges."""
        errors = self._near_errors * sizes(self.result.matrix, self.free)
        return float(errors.norm() / sizes(*self._whole))

    @cached_property
    def _near_errors(self) -> torch.Tensor:
        """The errors (P,) of points, and by sources, beside surfaces and edges."""
        plan, places = self.plan, (self.points, self.plan.scene.array.nodes.positions)
        settings = self.result.matrix, self.free, *places, plan.region, plan.spacing
        return reading_errors(*settings) + edge_errors(*settings)

    def _errors(self, form: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
        """Return the errors of the rows of the matrices in a form: by grids, shapes and rigid bodies.

        Sound that enters by a gap that all grids close is taken to be as loud as in free space.
        """
        longest = _LONGER * self.result.periods
        calm = [pair for pair in self.others if pair[0].periods <= longest] or self.others[-1:]
        grids = [(form(other.matrix), spacing) for other, spacing in calm]
        matrix, free, plan = form(self.result.matrix), form(self.free), self.plan
        # only boxes know the incident field
        of_grids = errors_by_grids if plan.method == "full" else grid_errors
        errors = of_grids(matrix, free, plan.spacing, grids, plan.law)
        every = [matrix, *(form(other.matrix) for other, _ in self.others)]
        heard = torch.stack([each.any(dim=1) for each in every]).any(dim=0)
        errors = torch.where(heard, errors, 0.0)  # silence on all grids is exact, unless a gap is too narrow
        if self.missed.any():
            lost = form(self.free * self.missed[:, None]).norm(dim=1)
            errors += lost / torch.hypot(lost, matrix.norm(dim=1)).clamp(min=_TINY)
        return errors + shape_errors(matrix, free, plan.region) + rigid_errors(matrix, free, plan.region)


def _as_row(matrix: torch.Tensor) -> torch.Tensor:
    return matrix.reshape(1, -1)
