"""Transfer matrices of obstacles that move a little as one body, by short runs on coarser grids alone.

Seen from the obstacles, the array and the points move, and the grids stay. So errors of a grid change little
from pose to pose, and so does what short runs leave. G is the matrix of the pose at the start, C and D are
those of short runs on two coarser grids. Primes mark another pose:

    G' = C' + a (C' - D') + (G - C - a (C - D)).

The factor a fits G - C by C - D. The last term is what extrapolation leaves at the start. It stays right as
long as the matrix and C - D do, whose changes tell the error.
"""

from __future__ import annotations

import math
from typing import Literal, overload

import torch

from autdtorch.fdtd.region import MIN_CELLS_PER_WAVELENGTH
from autdtorch.propagators.box import BoxSimulation
from autdtorch.propagators.simulated import SimulatedPropagator
from autdtorch.scene.changes import seen_from_obstacles
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import REAL
from autdtorch.utils.process import cached_property, one_library_thread
from autdtorch.utils.units import angles
from autdtorch.utils.validation import ArrayLike, boolean, finite_vector, invalid, require_kind, within

_COARSER, _COARSEST = 1.7, 2.5
"""Cells of the coarser grids, relative to the propagator's. With long runs, errors of a hand at 1 mm that is
moved by 1 mm and 2 degrees are 0.4 to 0.6 %; with 2.0 and 2.5 they are 0.8 to 1.2 %, with 1.6 and 2.5 0.3 to
0.4 %, on a grid of 1.3 times the work. With 1.8, bodies of three cells are off by up to 4 %."""

_SHARES = 0.55, 0.3
"""Periods of runs on these grids, relative to a run of the propagator to the steady state. Of that hand, long
runs leave 0.63 %, shares of 0.55 and 0.4 0.76 %, 0.52 and 0.3 0.84 %, 0.5 and 0.375 0.92 %."""

_CAUTION = 1.7
"""Safety factor: the last term changes by this many times the changes of the matrix and of C - D together."""

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
        require_kind("propagator", propagator, SimulatedPropagator)
        if propagator.method != "box":
            raise invalid("propagator", f"of method {propagator.method}", "must be of method box")
        self.propagator = propagator
        wavelength, spacing = propagator.plan.region.shortest_wavelength, propagator.spacing
        most = wavelength / MIN_CELLS_PER_WAVELENGTH / _COARSEST
        if spacing > most:
            accepted = f"must be at most {most:.4g} m: {_COARSEST:g} times coarser grids must serve"
            raise invalid("propagator.spacing", spacing, accepted, "m")
        self.spacings = _COARSER * spacing, _COARSEST * spacing

    def __repr__(self) -> str:
        """The propagator, and the spacings."""
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
            return_error: also return the estimated relative error (L2 of the whole matrix), against a new
                simulation of the pose by the propagator's settings.
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
        matrix = coarse + factor * difference + before
        if not with_error:
            return matrix
        pairs = (coarse, start), (difference, change)
        changes = [(now - then).norm() / then.norm().clamp_min(_TINY) for now, then in pairs]
        told = _CAUTION * math.hypot(*changes) * before.norm() / matrix.norm().clamp_min(_TINY)
        return matrix, float(told)

    @cached_property
    def _start(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """The matrix (P, M) by short runs, its difference of grids, what extrapolation leaves, its factor."""
        matrix = self.propagator.transfer_matrix()
        coarse, difference = self._coarse(self.propagator.scene)
        error = matrix - coarse
        size = difference.norm().square().clamp_min(_TINY)
        factor = torch.vdot(difference.reshape(-1), error.reshape(-1)) / size
        return coarse, difference, error - factor * difference, factor

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
