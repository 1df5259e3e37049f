"""Approximations of matrices of low rank from blocks of their rows and columns."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from autdtorch.fdtd.box_coupling import cross_approximation


def approximated(matrix, most=120):
    """The product of the factors of a matrix or None, and the numbers of the rows that were asked for."""
    asked = []

    def rows(numbers):
        asked.extend(numbers)
        return matrix[numbers]

    factors = cross_approximation(rows, lambda numbers: matrix[:, numbers], matrix.shape, most)
    return None if factors is None else factors[0] @ factors[1], asked


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 20), st.integers(0, 10**6))
def test_matrices_of_low_rank_are_exact(height, width, rank, seed):
    """Of any shape, zero and those of full rank among them; pivots may be small: 1e-8."""
    random = np.random.default_rng(seed)
    left, right = random.normal(size=(2, height, rank)), random.normal(size=(2, rank, width))
    matrix = (left[0] + 1j * left[1]) @ (right[0] + 1j * right[1])
    product, _ = approximated(matrix)
    assert np.linalg.norm(product - matrix) <= 1e-8 * np.linalg.norm(matrix)


@given(st.floats(1.0, 4.0), st.floats(0.3, 3.0), st.integers(0, 10**6))
def test_waves_between_places_apart_have_low_rank(apart, size, seed):
    """In wavelengths. An approximation ends at terms of 1e-5; those left out may add up to more."""
    random = np.random.default_rng(seed)
    points, sources = size * (random.uniform(size=(2, 200, 3)) - 0.5)
    distance = cdist(points, sources + np.array([size + apart, 0, 0]))
    matrix = np.exp(2j * math.pi * distance) / distance
    product, asked = approximated(matrix)
    assert np.linalg.norm(product - matrix) < 1e-4 * np.linalg.norm(matrix)
    assert len(asked) == len(set(asked)) < 120


def test_a_rank_above_the_most_has_no_factors():
    matrix = np.random.default_rng(0).normal(size=(60, 60)).astype(complex)
    product, asked = approximated(matrix, 32)
    assert product is None
    assert len(asked) == 32
