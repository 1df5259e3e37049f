"""Certificates for drives over all places of the obstacles in a ball, not at samples alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.objectives.goals import WEAKEST_FOCUS, WeakestFocus
from autdtorch.objectives.least_in_ball import least_in_ball
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.propagators.tmatrix.shift_polynomial import ShiftPolynomial
from autdtorch.scene.drive import validate_drive
from autdtorch.utils.process import cached_property
from autdtorch.utils.validation import ArrayLike, invalid, number_between, positive, require_kind

_CLOSE = 2e-3  # relative distance of a certificate to the worst pose, at which the search ends


@dataclass(frozen=True, eq=False)
class Certificate:
    """The weakest focus of a drive over all places of the obstacles in a ball.

    Attributes:
        least: proven: at no place is the weakest focus lower [Pa].
        worst: weakest focus at the worst place that the search met [Pa].
        offsets: shifts (K, 3) [m] to low places, far from each other; the worst first.
    """

    least: float
    worst: float
    offsets: torch.Tensor

    def __repr__(self) -> str:
        """Return the pressures, and the shift to the worst place."""
        shift = ", ".join(f"{1e3 * entry:.2f}" for entry in self.offsets[0].tolist())
        return f"Certificate(at least {self.least:.4g} Pa, {self.worst:.4g} Pa at ({shift}) mm)"


class PoseBall:
    """All places of a scene's obstacles within a distance of theirs: they shift as one body.

    The transfer matrix is a polynomial of the shift, with a proven error. The proof holds for the T-matrices
    as they are: it covers neither their errors nor turns.

    Attributes:
        propagator: of the scene.
        radius: largest shift [m].
        tolerance: error of the polynomial, relative to the pressure of all transducers in phase.
    """

    def __init__(self, propagator: TMatrixPropagator, radius: float, tolerance: float = 1e-4) -> None:
        """Check the arguments; nothing is computed here.

        Args:
            propagator: by ``make_propagator(scene, "tmatrix")``, without reflectors. Points and transducers
                must be outside the spheres around all bodies, by 1.74 times the radius.
            radius: largest shift [m], > 0.
            tolerance: 1e-8 to 0.01.

        Raises:
            ValueError: another propagator, reflectors, or a number out of range.
        """
        require_kind("propagator", propagator, TMatrixPropagator)
        if propagator.scene.reflectors:
            raise invalid("propagator", propagator, "must be of a scene without reflectors")
        if not propagator.scene.obstacles:
            raise invalid("propagator", propagator, "must be of a scene with obstacles")
        self.propagator = propagator
        self.radius = positive("radius", radius, "m")
        self.tolerance = number_between("tolerance", tolerance, 1e-8, 1e-2)

    def __repr__(self) -> str:
        """Return scene and radius."""
        return f"PoseBall(scene {self.propagator.scene.name!r}, radius {1e3 * self.radius:.4g} mm)"

    def transfer_matrix(self, offset: ArrayLike) -> torch.Tensor:
        """Return transfer matrices (..., P, M) [Pa] after shifts (..., 3) [m], by the T-matrices."""
        scene, bodies = self.propagator.scene, self.propagator.bodies
        return bodies.moved(offset).transfer_matrix(scene.array, scene.control_points)

    def certificate(self, drive: ArrayLike, goal: WeakestFocus = WEAKEST_FOCUS) -> Certificate:
        """Return the certificate of a drive (M,), by branch and bound over the ball.

        Args:
            drive: (M,), |q| <= 1.
            goal: with the weights of the foci, if any; its scores are certified.

        Raises:
            ValueError: another drive or goal, points or transducers near the bodies, waves between
                bodies that do not converge, or a radius that is too large for the tolerance.
        """
        scene = self.propagator.scene
        played = validate_drive(drive, len(scene.array)).detach().cpu().to(torch.complex128)
        if played.ndim != 1:
            raise ValueError(f"drive: shape {tuple(played.shape)}; must be ({len(scene.array)},)")
        require_kind("goal", goal, WeakestFocus)
        goal.check(len(scene.control_points))
        wanted, polynomial = goal.wanted(len(scene.control_points)), self._polynomial
        field = polynomial.coefficients @ played.numpy() / wanted
        error = polynomial.error @ np.abs(played.numpy()) / wanted
        least = least_in_ball(field, error, _CLOSE)
        offsets = torch.from_numpy(self.radius * least.places)
        scores = goal((self.transfer_matrix(offsets) @ played).abs())
        order = scores.argsort(stable=True)
        return Certificate(least.bound, float(scores.min()), offsets[order])

    @cached_property
    def _polynomial(self) -> ShiftPolynomial:
        scene = self.propagator.scene
        settings = scene.array, scene.control_points, self.radius, self.tolerance
        polynomial = ShiftPolynomial.of(self.propagator.bodies, *settings)
        if not self.propagator.by_waves(scene.control_points)[1].all():
            accepted = "must have waves that converge to its tolerance at all control points"
            raise invalid("propagator", self.propagator, accepted)
        return polynomial
