"""The transfer matrix of obstacles that shift as one body, as a polynomial of the shift with a proven error.

The scattered field is w(u)^T T d(u): d are the waves that come to the body at the shift u, and w brings to a
point what it scatters. Along any direction, the derivative of waves of degree n consists of waves of the
degrees n - 1 and n + 1. Their factors are the wavenumber and maps of norms s(n) and s(n + 1), with
s(n) = n / (4 n^2 - 1)^(1/2). The norm of the outgoing waves of a degree falls with the distance. So norms at
the least distance bound the derivatives of any order, the product rule bounds those of the field, and these
the error of interpolation in Chebyshev points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.polynomial import chebyshev
from scipy.special import spherical_jn, spherical_yn

from autdtorch.propagators.tmatrix.tmatrix import TMatrixCluster
from autdtorch.scene.arrays import TransducerArray, complex_strengths_of, radii_of
from autdtorch.utils.array_types import Array, ComplexArray
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import invalid

_DEGREES = range(4, 41)  # of the polynomial along each axis


@dataclass(frozen=True, eq=False)
class ShiftPolynomial:
    """Transfer matrices of all shifts u in a cube, in Chebyshev polynomials of u over its half edge.

    Attributes:
        half: half edge of the cube around no shift [m].
        coefficients: (n, n, n, P, M) [Pa], by the degrees along x, y and z.
        error: at most |G_pm(u) - polynomial| in the cube, for these T-matrices (P, M) [Pa].
    """

    half: float
    coefficients: ComplexArray
    error: Array

    @classmethod
    @one_library_thread()
    def of(
        cls,
        bodies: TMatrixCluster,
        array: TransducerArray,
        points: torch.Tensor,
        half: float,
        tolerance: float,
    ) -> ShiftPolynomial:
        """Interpolate the transfer matrix of bodies in a cube of half edge `half` [m].

        Args:
            bodies: at one pose, without reflectors.
            array: of the M transducers.
            points: (P, 3) [m].
            half: > 0 [m].
            tolerance: largest sum of errors of a row, over the sum of its magnitudes without shift.

        Raises:
            ValueError: shifts that are too large: beyond a transducer or point, or for the tolerance.
        """
        start = bodies.transfer_matrix(array, points).abs().sum(dim=1).numpy()
        bounds = _Bounds.of(bodies, array, points, half)
        for degree in _DEGREES:
            error = bounds.error(degree)
            if (error.sum(axis=1) <= tolerance * start).all():
                break
        else:
            raise invalid("radius", half, f"must be smaller, for an error of {tolerance:g}", "m")
        count = degree + 1
        nodes = np.cos(math.pi * (np.arange(count) + 0.5) / count)
        grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 3)
        with torch.no_grad():
            matrices = bodies.moved(half * grid).transfer_matrix(array, points).numpy()
        transform = chebyshev.chebvander(nodes, degree).T * 2 / count
        transform[0] /= 2
        values = matrices.reshape(count, count, count, *matrices.shape[1:])
        for _ in range(3):  # each turn transforms the first axis and puts it behind the next two
            values = np.moveaxis(np.tensordot(transform, values, axes=1), 0, 2)
        return cls(half, values, error)


@dataclass(frozen=True, eq=False)
class _Bounds:
    """Bounds of waves in a cube of shifts, by body and degree, for each order of derivatives.

    Derivatives are by shifts over the half edge of the cube.

    Attributes:
        at_points: on the norms of the waves of each degree at points (J, P, n).
        incoming: on those from transducers at full drive (J, M, n) [Pa].
        scattering: norms of the T-matrices' blocks of two degrees (n, n).
    """

    at_points: Array
    incoming: Array
    scattering: Array

    @classmethod
    def of(cls, bodies: TMatrixCluster, array: TransducerArray, points: torch.Tensor, half: float) -> _Bounds:
        """Compute the bounds for a cube of half edge `half` [m]."""
        far, orders = math.sqrt(3) * half, _DEGREES[-1] + 2
        wavenumber = abs(bodies.bodies[0].wavenumber)
        at_points, ends = list[Array](), [0]
        incoming = list[Array]()
        for body in bodies.bodies:
            away = (points - body.center).norm(dim=1).numpy() - far
            beside = (array.positions - body.center).norm(dim=1).numpy() - radii_of(array).numpy() - far
            for name, distance in (("points", away), ("array.positions", beside)):
                if distance.min() < body.radius:
                    least = body.radius + far
                    raise invalid(
                        "radius", half, f"a shift by {far:.3g} m must leave {name} {least:.4g} m away", "m"
                    )
            for parts, distance in ((at_points, away), (incoming, beside)):
                parts.append(_derivatives(distance, body.degree, wavenumber, half, orders))
            for degree in range(body.degree + 1):
                ends.append(ends[-1] + 2 * degree + 1)
        strengths = 4 * math.pi * wavenumber * complex_strengths_of(array).abs().numpy()
        whole = bodies.bodies[0].matrix if len(bodies.bodies) == 1 else bodies._joined
        blocks = [np.split(rows, ends[1:-1], axis=1) for rows in np.split(whole.numpy(), ends[1:-1])]
        norms = np.array([[np.linalg.norm(block, 2) for block in row] for row in blocks])
        together = np.concatenate(incoming, axis=2) * strengths[:, None]
        return cls(np.concatenate(at_points, axis=2), together, norms)

    def error(self, degree: int) -> Array:
        """Return the bound (P, M) [Pa] on the error of interpolation of a degree in all three axes.

        Interpolation in n + 1 Chebyshev points of an axis errs by at most 2 (h / 2)^(n + 1) / (n + 1)! times
        the largest derivative of the order n + 1. One axis is interpolated after the other, and each
        multiplies the errors before by at most L = 1 + (2 / pi) log(n + 1).
        """
        order = degree + 1
        derivative = sum(
            math.comb(order, j) * (self.at_points[order - j] @ self.scattering @ self.incoming[j].T)
            for j in range(order + 1)
        )
        growth = 1 + 2 / math.pi * math.log(order)
        along_one = 2 * math.exp(-order * math.log(2) - math.lgamma(order + 1))
        error: Array = along_one * (1 + growth + growth**2) * derivative
        return error


def _derivatives(distance: Array, degree: int, wavenumber: float, half: float, orders: int) -> Array:
    """Return bounds (J, D, n) on the norms of each degree's outgoing waves at distances (D,) [m] or more.

    They are those of derivatives of the orders 0 to J - 1, times `half` [m] to the power of the order.
    """
    every = np.arange(degree + orders + 1)
    place = wavenumber * distance[:, None]
    size = np.hypot(spherical_jn(every, place), spherical_yn(every, place))
    bound = size * np.sqrt((2 * every + 1) / (4 * math.pi))
    step = every[1:] / np.sqrt(4.0 * every[1:] ** 2 - 1)
    bounds = []
    for _ in range(orders):
        bounds.append(bound[:, : degree + 1])
        below = np.zeros_like(bound)
        below[:, 1:] += step * bound[:, :-1]
        below[:, :-1] += step * bound[:, 1:]
        bound = wavenumber * half * below[:, :-1]
        step = step[:-1]
    return np.stack(bounds)
