"""Certificates for drives over all places of the obstacles in a ball, not at samples alone.

The least magnitude of polynomials in a ball is known between two numbers, by branch and bound. A cell is a
cube, on which the polynomials have Chebyshev coefficients c. As no Chebyshev polynomial exceeds 1 there, and
with the phase f of the coefficient c0 of the constant,

    |p| >= Re(e^(-i f) p) >= |c0| - sum |Re(e^(-i f) c)|, over all other coefficients.

Cells are halved along all axes, which leaves fewer coefficients: high degrees, once small, become a part of
the error. Cells whose bound is close to the least value attained, or above it, are not divided.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.polynomial import chebyshev

from autdtorch.objectives.goals import WEAKEST_FOCUS, WeakestFocus
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.propagators.tmatrix.shift_polynomial import ShiftPolynomial
from autdtorch.scene.drive import validate_drive
from autdtorch.utils.array_types import Array, ComplexArray
from autdtorch.utils.process import cached_property
from autdtorch.utils.validation import ArrayLike, invalid, number_between, positive, require_kind

_CLOSE = 2e-3  # relative distance of a certificate to the worst pose, at which the search ends

_DROPPED = 1e-6  # Coefficients that become error at a halving, over the sum of all at first
_ROUNDING = 1e-12  # of all coefficients, over their sum
_MOST_CELLS = 60_000
_LOW, _APART, _MOST_PLACES = 1.1, 0.5, 8  # values over the lowest, distances and number of low places
_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


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


class Least(NamedTuple):
    """The least magnitude in a ball.

    Attributes:
        bound: no magnitude in the ball is lower.
        places: of low magnitudes (K, 3), in the unit ball and far from each other; the lowest first.
    """

    bound: float
    places: Array


def least_in_ball(coefficients: ComplexArray, error: Array, tolerance: float) -> Least:
    """Return the least magnitude of P polynomials in the unit ball.

    Args:
        coefficients: by the degrees along x, y and z (n, n, n, P), in Chebyshev polynomials.
        error: of each polynomial (P,), by which the bound is lower.
        tolerance: relative distance of bound and attained value at which cells are not divided.
    """
    cells = np.moveaxis(coefficients, 3, 0)[None]  # (C, P, n, n, n)
    sums = np.abs(cells[0]).sum(axis=(1, 2, 3))
    errors, centres, half = (error + _ROUNDING * sums)[None], np.zeros((1, 3)), 1.0
    done, attained, samples = math.inf, math.inf, []
    while True:
        samples.append(_samples(cells, centres, half))
        attained = min(attained, samples[-1][0].min(initial=math.inf))
        bounds = _bounds(cells, errors)
        open_ = bounds < attained * (1 - tolerance)
        done = min(done, bounds[~open_].min(initial=math.inf))
        if not open_.any() or 8 * open_.sum() > _MOST_CELLS:
            least = min(done, bounds[open_].min(initial=math.inf))
            values, places = map(np.concatenate, zip(*samples, strict=True))
            return Least(max(0.0, float(least)), _apart(values, places))
        half /= 2
        cells, errors = _halved(cells[open_]), np.repeat(errors[open_], 8, axis=0)
        centres = (centres[open_][:, None] + 2 * half * _CORNERS).reshape(-1, 3)
        inside = np.linalg.norm(np.maximum(np.abs(centres) - half, 0), axis=1) <= 1
        cells, dropped = _trimmed(cells[inside], _DROPPED * sums.min())
        errors, centres = errors[inside] + dropped, centres[inside]


def _bounds(cells: ComplexArray, errors: Array) -> Array:
    """Return the bounds (C,) of the cells, the least of all polynomials."""
    flat = cells.reshape(*cells.shape[:2], -1)
    size = np.abs(flat[..., 0])
    turn = flat[..., :1].conj() / np.maximum(size, np.finfo(np.float64).tiny)[..., None]
    rest = np.abs((turn * flat[..., 1:]).real).sum(axis=-1)
    bounds: Array = (size - rest - errors).min(axis=1)
    return bounds


def _apart(values: Array, places: Array) -> Array:
    """Return places (K, 3) of low values (N,), the lowest first."""
    chosen: list[Array] = []
    low = np.argsort(values, kind="stable")
    for place in places[low[values[low] <= _LOW * values.min()]]:
        if all(np.linalg.norm(place - other) > _APART for other in chosen):
            chosen.append(place)
    return np.array(chosen[:_MOST_PLACES])


def _samples(cells: ComplexArray, centres: Array, half: float) -> tuple[Array, Array]:
    """Return least magnitudes (K,) at places (K, 3): centres of cells, or the nearest in cell and ball."""
    places = centres / np.maximum(np.linalg.norm(centres, axis=1, keepdims=True), 1)
    local = (places - centres) / half
    within = np.abs(local).max(axis=1) <= 1
    cells, local, places = cells[within], local[within], places[within]
    x, y, z = (chebyshev.chebvander(local[:, axis], cells.shape[-1] - 1) for axis in range(3))
    value = np.einsum("cpijk,ck->cpij", cells, z)
    value = np.einsum("cpij,cj->cpi", value, y)
    return np.abs(np.einsum("cpi,ci->cp", value, x)).min(axis=1), places


def _halved(cells: ComplexArray) -> ComplexArray:
    """Return the coefficients (8 C, P, n, n, n) of the eight parts of each cell."""
    for _ in range(3):  # each turn halves along the last axis and puts it before the other two
        sides = [cells @ half for half in _halves(cells.shape[-1])]
        cells = np.moveaxis(np.stack(sides), -1, -3)
    return np.moveaxis(cells, 3, 0).reshape(-1, *cells.shape[4:])


@functools.lru_cache(64)
def _halves(count: int) -> Array:
    """Return the maps (2, n, n) from coefficients (..., n) to those on the lower and the upper half."""
    nodes = np.cos(math.pi * (np.arange(count) + 0.5) / count)
    transform = chebyshev.chebvander(nodes, count - 1).T * 2 / count
    transform[0] /= 2
    sides = [(transform @ chebyshev.chebvander((nodes + side) / 2, count - 1)).T for side in (-1, 1)]
    return np.stack(sides)


def _trimmed(cells: ComplexArray, limit: float) -> tuple[ComplexArray, Array]:
    """Return cells of fewer degrees, and the sums (C, P) of the coefficients dropped, at most `limit`."""
    sizes = np.abs(cells)
    whole = sizes.sum(axis=(2, 3, 4))
    for count in range(2, cells.shape[-1]):
        dropped = whole - sizes[..., :count, :count, :count].sum(axis=(2, 3, 4))
        if dropped.max(initial=0.0) <= limit:
            return cells[..., :count, :count, :count], np.maximum(dropped, 0.0)
    return cells, np.zeros(cells.shape[:2])
