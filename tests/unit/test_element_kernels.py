"""Compiled loops over elements, against their definitions in NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.fdtd.assembly.cell_kernels import least_masses
from autdtorch.fdtd.assembly.element_kernels import mix_materials
from autdtorch.fdtd.assembly.layered_elements import Survey
from autdtorch.fdtd.assembly.reference_element import (
    FAR,
    LATTICE,
    PAIRS,
    SUBCELLS,
    shares,
    stiffness_matrix,
    subcell_gradients,
    subcell_means,
    volume_coverage,
)

SEEDS = st.integers(0, 10_000)
ROUNDING = 1e-12  # of sums of hundreds of numbers around one


def distances(random, bodies, count):
    """Distances (bodies, count, 125) from bent surfaces; some bodies are far."""
    quadratic = np.concatenate((LATTICE, LATTICE**2), axis=1)
    values = random.normal(size=(bodies, count, 6)) @ quadratic.T + random.normal(size=(bodies, count, 1))
    values /= np.maximum(1, np.ptp(values, axis=2, keepdims=True) / 3**0.5)  # over the diagonal of an element
    values[random.random((bodies, count)) < 0.2] = FAR
    return values


@given(SEEDS)
@settings(max_examples=20)
def test_share_of_a_subcell_is_that_of_a_plane_through_its_mean(seed):
    level = distances(np.random.default_rng(seed), 1, 7)[0]
    width = np.abs(subcell_gradients(level)).sum(axis=2) / SUBCELLS
    expected = np.clip(0.5 - subcell_means(level) / np.maximum(width, 1e-12), 0, 1)
    assert np.abs(volume_coverage(level) - expected).max() < ROUNDING


@given(SEEDS, st.integers(1, 3))
@settings(max_examples=20)
def test_means_over_materials_are_those_by_their_shares(seed, bodies):
    random = np.random.default_rng(seed)
    distance, grown = distances(random, bodies, 5), random.uniform(-0.1, 0.1, (bodies, 5))
    material, values = random.integers(1, 4, bodies), random.normal(size=(2, 4))
    mixed = np.empty((2, 5, SUBCELLS**3))
    mix_materials(distance, grown, material, values, mixed)
    share = shares(volume_coverage, distance - grown[:, :, None], material, 4)
    assert np.abs(np.moveaxis(mixed, 0, -1) - share @ values.T).max() < ROUNDING


@given(SEEDS)
@settings(max_examples=20)
def test_flush_bodies_have_shares_in_any_order(seed):
    """The later one had more of the sub-cells that the seam cuts, of two halves 2/3."""
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    level = (LATTICE - random.uniform(0.3, 0.7, 3)) @ (normal / np.linalg.norm(normal))
    flush, numbers = np.stack((level, -level))[:, None], np.array([1, 2])
    one, other = (shares(volume_coverage, flush[::turn], numbers[::turn], 3) for turn in (1, -1))
    # seen from both sides, the union is less than one in sub-cells whose corners show only distances from it
    assert np.abs(one - other).max() < 0.1
    assert np.abs(one.mean(axis=1) - other.mean(axis=1)).max() < 0.02


def test_distances_that_vary_along_one_axis_are_layered_along_it():
    random = np.random.default_rng(0)
    across = random.normal(size=(3, 5))
    profiles = [LATTICE[:, axis] * 4 for axis in range(3)]
    layered = [along[places.astype(int)] for along, places in zip(across, profiles, strict=True)]
    survey = Survey.of(np.array([[*layered, np.full(125, 0.7), random.normal(size=125)]]))
    assert (survey.axis(np.zeros((1, 5), bool)) == (0, 1, 2, 2, -1)).all()
    both = Survey.of(np.array([[layered[0]], [layered[1]]]))
    assert both.axis(np.zeros((2, 1), bool)) == -1
    assert both.axis(np.array([[False], [True]])) == 0  # without the second body


@given(SEEDS)
@settings(max_examples=20)
def test_least_masses_are_those_with_which_elements_have_the_largest_eigenvalue(seed):
    random = np.random.default_rng(seed)
    coupling = random.random((6, len(PAIRS))) * 10 ** random.uniform(-6, 2, (6, 1))
    coupling[:2] *= random.random((2, len(PAIRS))) < 0.4  # in several parts
    coupling[2] = coupling[2, 0]  # whose eigenvalues are equal
    stiff = stiffness_matrix(coupling)
    alone = np.diagonal(stiff, axis1=1, axis2=2)
    mass = random.uniform(0.5, 2, (6, 8)) * alone  # some of which suffice
    mass[4, 3] = 0
    least = np.empty((6, 8))
    least_masses(coupling, mass, PAIRS, 1.7, least)
    assert np.abs(_largest_eigenvalue(stiff, least) - 1.7).max() < ROUNDING
    positive = np.where((mass > 0) | (alone == 0), mass, 1e-9)
    suffice = _largest_eigenvalue(stiff, positive) <= 1.7
    for row, shape in enumerate(np.where(suffice[:, None], mass, alone)):
        assert least[row] == pytest.approx(shape * least[row].sum() / shape.sum(), rel=ROUNDING)


def _largest_eigenvalue(stiff, mass):
    mass = np.where(mass > 0, mass, 1)
    return np.linalg.eigvalsh(stiff / np.sqrt(mass[:, :, None] * mass[:, None]))[:, -1]
