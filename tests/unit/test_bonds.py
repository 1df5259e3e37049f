import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.fdtd.bonds import speed_factors, varying_cells
from autdtorch.fdtd.grid import CellMedium
from autdtorch.fdtd.stencil import OFFSETS, Stencil, tuned_stencil

AIR_DENSITY, AIR_SPEED = 1.293, 340.0
STENCIL = tuned_stencil(2 * math.pi / 8.5)
SHAPE = (8, 8, 8)


def random_medium(seed: int, contrast: float, speed_ratio: float, rigid: float) -> CellMedium:
    """Random cells in the middle of air."""
    rng = np.random.default_rng(seed)
    density, speed, hard = np.full(SHAPE, AIR_DENSITY), np.full(SHAPE, AIR_SPEED), np.zeros(SHAPE, bool)
    core = (slice(2, -2),) * 3
    density[core] *= contrast ** rng.uniform(-1, 1, density[core].shape)
    speed[core] *= speed_ratio ** rng.uniform(-1, 1, speed[core].shape)
    hard[core] = rng.uniform(size=density[core].shape) < rigid
    return CellMedium(density, speed, hard)


def operator(medium: CellMedium, stencil: Stencil) -> np.ndarray:
    """Dense matrix of -sum_j w_ij (p_j - p_i) on a grid whose outermost cells are held at zero."""
    cells = varying_cells(medium, stencil, AIR_DENSITY, AIR_SPEED)
    count = math.prod(SHAPE)
    weight = np.tile(stencil.weights, (count, 1))
    weight[cells.index] = cells.weight
    inner = np.zeros(SHAPE, bool)
    inner[1:-1, 1:-1, 1:-1] = True
    rows = np.flatnonzero(inner)
    matrix = np.zeros((count, count))
    for offset, column in zip(np.array(OFFSETS) @ (64, 8, 1), weight.T, strict=True):
        matrix[rows, rows + offset] -= column[rows]
    matrix[rows, rows] += weight[rows].sum(1)
    return matrix[np.ix_(rows, rows)]


MEDIA = st.builds(
    random_medium, st.integers(0, 10**6), st.floats(1, 1e4), st.floats(1, 4), st.sampled_from([0.0, 0.3])
)


@settings(max_examples=25, deadline=None)
@given(MEDIA)
def test_bonds_are_symmetric_so_that_there_is_an_energy(medium: CellMedium) -> None:
    matrix = operator(medium, STENCIL)
    inside = (slice(1, -1),) * 3
    factors = speed_factors(STENCIL, medium.sound_speed[inside].ravel(), AIR_SPEED)
    mass = 1 / (medium.density[inside].ravel() * factors)
    energy = mass[:, None] * matrix
    # rounding of sums of terms up to the contrast apart
    assert np.allclose(energy, energy.T, rtol=1e-11, atol=1e-12 * np.abs(energy).max())
    assert np.linalg.eigvalsh(energy).min() > -1e-12 * np.abs(energy).max()


def test_uniform_air_has_no_varying_cells() -> None:
    air = random_medium(0, contrast=1.0, speed_ratio=1.0, rigid=0.0)
    cells = varying_cells(air, STENCIL, AIR_DENSITY, AIR_SPEED)
    assert len(cells.index) == 0


def test_a_heavy_interior_of_one_material_is_swept_as_air_is() -> None:
    # its bonds are all alike: only the surface differs (same sound speed)
    density = np.full((12, 12, 12), AIR_DENSITY)
    density[3:9, 3:9, 3:9] = 100.0
    medium = CellMedium(density, np.full(density.shape, AIR_SPEED), np.zeros(density.shape, bool))
    cells = varying_cells(medium, STENCIL, AIR_DENSITY, AIR_SPEED)
    assert len(cells.index) == 8**3 - 4**3


def test_speed_of_a_cell_is_tuned_to_its_own_wavenumber() -> None:
    # frequency of a plane wave of that medium's wavenumber, averaged over directions, is the drive's
    slow, fast = speed_factors(STENCIL, np.array([0.5 * AIR_SPEED, 4 * AIR_SPEED]), AIR_SPEED)
    assert slow * STENCIL.isotropic_symbol(2 * STENCIL.kappa) == pytest.approx(STENCIL.symbol)
    assert fast == pytest.approx(16, rel=0.05)  # (c / c_air)^2 but for the grid's dispersion


def test_modes_of_a_duct_of_two_fluids_are_exact() -> None:
    """A closed rigid duct, part air, part heavy fluid, along the grid: its resonances are known.

    With one speed, lengths a and b and impedances z1 and z2: z2 tan(k a) + z1 tan(k b) = 0. A step of density
    half way between two cells is exact for waves that meet it head on, so the discrete modes have the exact
    wavenumbers; what is left (1e-9) is the root finding of the test.
    """
    length_a, length_b = 9, 14
    density = np.full((length_a + length_b + 6, 7, 7), AIR_DENSITY)
    density[3 + length_a : -3, 3, 3] = 50.0
    hard = np.zeros(density.shape, bool)
    hard[2:-2, 2:-2, 2:-2] = True
    hard[3:-3, 3, 3] = False
    medium = CellMedium(density, np.full(density.shape, AIR_SPEED), hard)
    found = varying_cells(medium, STENCIL, AIR_DENSITY, AIR_SPEED)
    duct = np.ravel_multi_index((np.arange(3, length_a + length_b + 3), 3, 3), density.shape)
    weight = found.weight[np.searchsorted(found.index, duct)]
    matrix = np.diag(weight.sum(1)) - np.diag(weight[:-1, 22], 1) - np.diag(weight[1:, 4], -1)
    symbols = np.sort(np.linalg.eigvals(matrix).real)
    # in a duct one cell wide the face bonds act alone: symbol = face (2 - 2 cos k)
    discrete = np.arccos(1 - symbols[1:6] / (2 * STENCIL.face))
    assert np.allclose(discrete, _duct_modes(length_a, length_b, 1.0, 50.0 / AIR_DENSITY)[:5], rtol=1e-8)


def _duct_modes(a: float, b: float, z1: float, z2: float) -> np.ndarray:
    """Wavenumbers of z2 tan(k a) + z1 tan(k b) = 0, multiplied out so that nothing is singular."""
    k = np.linspace(1e-6, 1.0, 200001)
    value = z2 * np.sin(k * a) * np.cos(k * b) + z1 * np.sin(k * b) * np.cos(k * a)
    crossing = np.flatnonzero(np.diff(np.sign(value)))
    return k[crossing] - value[crossing] * (k[1] - k[0]) / (value[crossing + 1] - value[crossing])
