"""Transfer matrices of obstacles that move a little as one body, by short runs on coarser grids alone.

Seen from the obstacles, the array and the points move, and the grids stay. So errors of a grid change little
from pose to pose, and so does what short runs leave. G is the matrix of the pose at the start, C and D are
those of short runs on two coarser grids. Primes mark another pose:

    G' = C' + a (C' - D') + b (G - C - a (C - D)).

The factor a fits G - C by C - D. The last term is what extrapolation leaves at the start. The factors b, of
each entry, fit C' - D' by C - D over the transducers around: the last term changes as this difference does.
Changes of the matrix and of C - D tell the error.
"""

from __future__ import annotations

import math
from typing import Literal, overload

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from autdtorch.fdtd.region import MIN_CELLS_PER_WAVELENGTH
from autdtorch.propagators.box import BoxSimulation
from autdtorch.propagators.simulated import SimulatedPropagator
from autdtorch.scene.changes import seen_from_obstacles
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import REAL
from autdtorch.utils.process import cached_property, one_library_thread
from autdtorch.utils.units import angles
from autdtorch.utils.validation import ArrayLike, boolean, finite_vector, invalid, within

_COARSER, _COARSEST = 1.7, 2.5
"""Cells of the coarser grids, relative to the propagator's. With long runs, errors of a hand at 1 mm that is
moved by 1 mm and 2 degrees are 0.4 to 0.6 %; with 2.0 and 2.5 they are 0.8 to 1.2 %, with 1.6 and 2.5 0.3 to
0.4 %, on a grid of 1.3 times the work. With 1.8, bodies of three cells are off by up to 4 %."""

_SHARES = 0.53, 0.4
"""Periods of runs on these grids, relative to a run of the propagator to the steady state. Four moves of that
hand err by 0.9 % on average, by 0.7 % with long runs, and by 1.6 % with shares of 0.4 and 0.4."""

_AROUND = 25
"""Transducers over which a factor b is fitted: 13 to 61 differ by a thirtieth for that hand. Arrays of fewer
have b = 1: fits of 4 entries raise the errors of plates 4 mm apart by a half or more."""

_MOST = 2.0
"""Largest size of a factor b. Fits are larger where C - D almost vanishes at the start: beside a block that
moves by 4 mm they reach 7, and without a limit its matrix errs by a sixth more."""

_CAUTION = 1.3
"""Safety factor: the last term changes by this many times the changes of the matrix and of C - D together,
while these are small. It cannot be wrong by more than about its size."""

_TINY = torch.finfo(torch.float64).tiny


class NearbyPoses:
    """The poses near a propagator's scene: its obstacles are shifted and turned as one body.

    A matrix depends on the pose and the propagator's settings alone. The pose at the start is simulated once,
    on all three grids.

    Attributes:
        propagator: of the pose at the start, of method "box".
        spacings: of the coarser grids [m].
    """

    def __init__(self, propagator: SimulatedPropagator) -> None:
        """Choose the coarser grids; nothing is simulated here.

        Args:
            propagator: by `make_propagator` of method "box".

        Raises:
            ValueError: another propagator, or one whose cells are too large for coarser grids.
        """
        if not isinstance(propagator, SimulatedPropagator) or propagator.method != "box":
            accepted = 'must be of method "box", as of make_propagator(scene, method="box")'
            raise invalid("propagator", propagator, accepted)
        self.propagator = propagator
        wavelength, spacing = propagator.plan.region.shortest_wavelength, propagator.spacing
        most = wavelength / MIN_CELLS_PER_WAVELENGTH / _COARSEST
        if spacing > most:
            accepted = f"must be at most {most:.4g} m: a grid {_COARSEST:g} times as coarse must serve too"
            raise invalid("propagator.spacing", spacing, accepted, "m")
        self.spacings = _COARSER * spacing, _COARSEST * spacing

    def __repr__(self) -> str:
        return (
            f"NearbyPoses({self.propagator}, by {' and '.join(f'{1e3 * h:.4g}' for h in self.spacings)} mm)"
        )

    @overload
    def transfer_matrix(
        self,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike = (0.0, 0.0, 0.0),
        return_error: Literal[False] = False,
        *,
        rotation_degrees: ArrayLike | None = None,
    ) -> torch.Tensor: ...
    @overload
    def transfer_matrix(
        self,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike = (0.0, 0.0, 0.0),
        *,
        return_error: Literal[True],
        rotation_degrees: ArrayLike | None = None,
    ) -> tuple[torch.Tensor, float]: ...
    @one_library_thread()
    def transfer_matrix(
        self,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike = (0.0, 0.0, 0.0),
        return_error: bool = False,
        *,
        rotation_degrees: ArrayLike | None = None,
    ) -> torch.Tensor | tuple[torch.Tensor, float]:
        """Return the transfer matrix (P, M) [Pa] of the control points after obstacles move as one body.

        Args:
            offset: (3,) [m], from the propagator's scene, as in `Scene.moved`.
            rotation: angles (3,) [rad] about the fixed axes x, y, z, in this order.
            return_error: also return the estimated relative error (L2 of the whole matrix), against a
                simulation of the pose on the propagator's grids: 0 without a move. The error of those grids
                comes on top, `propagator.known_error` where it is estimated. A new simulation may place its
                grids otherwise, and differ by it.
            rotation_degrees: these angles (3,) in degrees, in place of `rotation`.

        Raises:
            ValueError: obstacles that cannot be moved so, or that then hold a transducer or control point.
        """
        with_error = boolean("return_error", return_error)
        shift, turn = finite_vector("offset", offset), angles("rotation", rotation, rotation_degrees)
        scene = self.propagator.scene
        place, angle = (", ".join(f"{entry:.4g}" for entry in entries) for entries in (shift, turn))
        with within(f"offset ({place}) m, rotation ({angle}) rad"):
            moved = scene.moved(shift, turn)
        seen, _ = seen_from_obstacles(moved, scene.obstacles, torch.tensor(shift, **REAL), turn)
        coarse, difference = self._coarse(seen)
        start, change, before, factor = self._start
        follows = 1 + self._fitted(difference - change, change)  # at the start 1, to the last bit
        follows = follows / (follows.abs() / _MOST).clamp_min(1)
        matrix = coarse + factor * difference + follows * before
        if not with_error:
            return matrix
        pairs = (coarse, start), (difference, change)
        changed = math.hypot(*((now - then).norm() / then.norm().clamp_min(_TINY) for now, then in pairs))
        wrong = _CAUTION * math.sin(math.atan(changed)) * before.norm()
        return matrix, float(wrong / matrix.norm().clamp_min(_TINY))

    @cached_property
    def _start(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """The matrix (P, M) by short runs, its difference of grids, what extrapolation leaves, its factor."""
        matrix = self.propagator.transfer_matrix()
        coarse, difference = self._coarse(self.propagator.scene)
        error = matrix - coarse
        size = difference.norm().square().clamp_min(_TINY)
        factor = torch.vdot(difference.reshape(-1), error.reshape(-1)) / size
        return coarse, difference, error - factor * difference, factor

    def _fitted(self, matrix: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        """Return the factors (P, M) by which another matrix fits a matrix (P, M) around each transducer."""
        products = matrix * other.conj(), other.abs().square()
        product, square = (torch.from_numpy(self._around @ each.mT.numpy()).mT for each in products)
        return product / square.clamp_min(_TINY)

    @cached_property
    def _around(self) -> csr_array:
        """The sum (M, M) over the nearest transducers of each, or none where these are too few."""
        places = self.propagator.scene.array.positions.numpy()
        if len(places) < _AROUND:
            return csr_array((len(places), len(places)))
        _, nearest = KDTree(places).query(places, _AROUND)
        ends = np.arange(0, nearest.size + 1, _AROUND)
        return csr_array((np.ones(nearest.size), nearest.ravel(), ends))

    def _coarse(self, scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the matrix (P, M) on the finer of the coarse grids, and its difference from the other."""
        matrix, other = (
            each.around(scene).transfer_matrix(scene.control_points).matrix for each in self._simulations
        )
        return matrix, matrix - other

    @cached_property
    def _simulations(self) -> list[BoxSimulation]:
        """The simulations of the pose at the start by short runs."""
        simulation, grouping = self.propagator.simulation, self.propagator.plan.grouping
        assert isinstance(simulation, BoxSimulation)
        stepped = simulation.transfer_matrix(self.propagator.scene.control_points).periods
        periods = stepped / (len(grouping.grids) * grouping.passes)
        settings = zip(self.spacings, _SHARES, strict=True)
        return [simulation.short(spacing, math.ceil(share * periods)) for spacing, share in settings]
