"""Elements at faces and edges parallel to the grid, against exact waves and singular fields."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.fdtd.assembly.aligned_edges import edge_coupling
from autdtorch.fdtd.assembly.aligned_faces import matched
from autdtorch.fdtd.stencil import tuned_stencil

RATIOS = st.floats(-1.5, 5).map(lambda exponent: 10**exponent)
PLACES = st.floats(0.0, 1.0)


def reflection(kappa: float, density: float, slowness: float, place: float) -> tuple[complex, complex]:
    """Return the reflection of a chain of cells, and the exact one.

    The last cell of air lies `place` before the face. The density of the other material is assembled so that
    waves keep their flow at the face.
    """
    near, beyond = kappa, kappa * slowness
    assembled = density * (math.sin(beyond) / beyond) / (math.sin(near) / near)
    depths, densities = np.array([[place, 1 - place]]), np.array([[1.0, assembled]])
    link, _, thickness = matched(depths, densities, np.array([[near, beyond]]))
    mass = (thickness[0] + 0.5) * 4 * np.sin(np.array([near, beyond]) / 2) ** 2 / densities[0]

    def wave(wavenumber: float, place: float) -> complex:
        return cmath.exp(1j * wavenumber * place)

    first, second = -place, 1 - place
    matrix, right = np.zeros((2, 2), complex), np.zeros(2, complex)
    for sign, column in ((1, right), (-1, matrix[:, 0])):
        here, before = wave(sign * near, first), wave(sign * near, first - 1)
        column[:] = before - here - link[0] * here + mass[0] * here, link[0] * here
    here, after = wave(beyond, second), wave(beyond, second + 1)
    matrix[:, 1] = link[0] * here, (after - here) / assembled - link[0] * here + mass[1] * here
    exact = (density / slowness - 1) / (density / slowness + 1)
    return complex(np.linalg.solve(matrix, -right)[0]), exact


@settings(max_examples=100)
@given(RATIOS, st.floats(0.3, 1.5), PLACES)
def test_a_wave_is_reflected_exactly_wherever_the_face_falls(
    density: float, slowness: float, place: float
) -> None:
    """The error is of fourth order; its largest coefficient in 20,000 random cases was 0.11."""
    for kappa in (0.1, 0.3, 0.7):
        found, exact = reflection(kappa, density, slowness, place)
        assert abs(found - exact) < 0.3 * kappa**4


@settings(max_examples=40)
@given(st.tuples(PLACES, PLACES), RATIOS, st.booleans())
def test_the_coupling_at_an_edge(depth: tuple[float, float], density: float, touching: bool) -> None:
    stencil = tuned_stencil(0.7)
    coupling = edge_coupling(depth, (density, 1.0), stencil, touching)
    pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    matrix = np.zeros((4, 4))
    straight, diagonal = stencil.face / 2 + stencil.edge, stencil.edge + 2 * stencil.corner
    for (one, other), value in zip(pairs, coupling, strict=True):
        matrix[one, other] = matrix[other, one] = -value * (diagonal if one + other == 3 else straight)
    matrix -= np.diag(matrix.sum(axis=0))
    assert np.linalg.eigvalsh(matrix).min() > -1e-9 * np.abs(matrix).max()  # rounding
    mirrored = edge_coupling(depth[::-1], (density, 1.0), stencil, touching)
    # the mean over four images of touching edges is summed in another order
    assert mirrored == pytest.approx(coupling[[1, 0, 2, 3, 5, 4]], rel=1e-12 if touching else 0, abs=0)


@pytest.mark.parametrize("depth", [(0.2, 0.7), (0.5, 0.5), (0.9, 0.1)])
def test_an_edge_of_air_in_air_is_none(depth: tuple[float, float]) -> None:
    """The fit ends where it starts, up to rounding."""
    assert edge_coupling(depth, (1.0, 1.0), tuned_stencil(0.3)) == pytest.approx(np.ones(6), abs=1e-9)
