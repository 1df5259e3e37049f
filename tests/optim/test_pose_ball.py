"""Certificates over a ball of places: the polynomial's error, branch and bound, and drives that hold."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import chebyshev

import autdtorch as at
from autdtorch.methods.gradient import random_drives
from autdtorch.objectives.pose_ball import least_in_ball
from autdtorch.propagators.tmatrix.shift_polynomial import ShiftPolynomial

RADIUS = 2e-3


def in_ball(count, generator, surface=False):
    places = generator.standard_normal((count, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    return places if surface else places * generator.random((count, 1)) ** (1 / 3)


@pytest.fixture(scope="module")
def balls():
    """Two balls of another fluid between an array and two foci."""
    array = at.TransducerArray.grid((3, 3), pitch=10e-3, center=(0, 0, 0), normal=(0, 0, 1))
    foci = at.circle_points(center=(0, 0, 80e-3), radius=15e-3, count=2, normal=(0, 0, 1))
    balls = [at.Sphere((x, 0, 40e-3), 6e-3, density=100.0, sound_speed=340.0) for x in (-7e-3, 7e-3)]
    scene = at.Scene(array, at.Medium.air(), frequency=40e3, control_points=foci, obstacles=tuple(balls))
    return at.make_propagator(scene, "tmatrix")


@pytest.fixture(scope="module")
def ball(balls):
    return at.PoseBall(balls, RADIUS)


@settings(max_examples=5)
@given(points=st.integers(1, 3), degree=st.integers(1, 5), seed=st.integers(0, 1000), decay=st.floats(0, 2))
def test_no_place_in_the_ball_is_below_the_bound(points, degree, seed, decay):
    generator = np.random.default_rng(seed)
    parts = generator.standard_normal((2, *[degree + 1] * 3, points))
    total = np.indices([degree + 1] * 3).sum(axis=0)[..., None]
    coefficients = (parts[0] + 1j * parts[1]) * np.exp(-decay * total)
    least = least_in_ball(coefficients, np.zeros(points), 1e-2)
    x, y, z = (chebyshev.chebvander(axis, degree) for axis in in_ball(2000, generator).T)
    values = np.abs(np.einsum("ai,aj,ak,ijkp->ap", x, y, z, coefficients, optimize=True)).min(axis=1)
    assert least.bound <= values.min()
    x, y, z = (chebyshev.chebvander(axis, degree) for axis in least.places.T)
    attained = np.abs(np.einsum("ai,aj,ak,ijkp->ap", x, y, z, coefficients, optimize=True)).min(axis=1)
    assert np.linalg.norm(least.places, axis=1).max() <= 1 + 1e-12
    dropped = 1e-6 * np.abs(coefficients).sum(axis=(0, 1, 2)).min()  # by a halving, of which there are few
    assert attained[0] <= attained.min() + 20 * dropped
    if attained[0] > 0.1 and decay > 0.5:  # a zero, or high degrees, take more cells than are allowed
        assert least.bound >= (1 - 0.02) * attained[0]


@pytest.mark.parametrize("half", [1e-3, 3e-3])
def test_the_polynomial_errs_by_no_more_than_it_says(balls, half):
    scene, generator = balls.scene, np.random.default_rng(0)
    polynomial = ShiftPolynomial.of(balls.bodies, scene.array, scene.control_points, half, 1e-3)
    shifts = np.concatenate([generator.uniform(-1, 1, (20, 3)), generator.choice([-1, 1], (8, 3))])
    exact = balls.bodies.moved(half * shifts).transfer_matrix(scene.array, scene.control_points).numpy()
    x, y, z = (chebyshev.chebvander(axis, len(polynomial.coefficients) - 1) for axis in shifts.T)
    off = np.abs(np.einsum("ai,aj,ak,ijkpm->apm", x, y, z, polynomial.coefficients, optimize=True) - exact)
    assert (off <= polynomial.error).all()
    assert (polynomial.error.sum(axis=1) <= 1e-3 * np.abs(exact[0]).sum(axis=1) * 1.5).all()


def test_derivatives_of_waves_are_below_their_bounds():
    from autdtorch.analytic.spherical_waves import outgoing_waves
    from autdtorch.propagators.tmatrix.shift_polynomial import _derivatives

    wavenumber, half, degree, step = 740.0, 2e-3, 5, 1e-5
    bounds = _derivatives(np.array([20e-3]), degree, wavenumber, half, 4)
    generator = np.random.default_rng(0)
    for direction in in_ball(5, generator, surface=True):
        axis = in_ball(1, generator, surface=True)[0]
        line = torch.from_numpy(20e-3 * direction + step * np.arange(-3, 4)[:, None] * axis)
        waves = outgoing_waves(degree, wavenumber, line).numpy()
        for order in range(3):  # central differences, whose error is far below the room in the bounds
            count, middle = order + 1, 3
            weights = np.array([(-1) ** (order - k) * math.comb(order, k) for k in range(count)])
            first = middle - order // 2
            difference = weights @ waves[first : first + count] * (half / step) ** order
            norms = [np.linalg.norm(difference[n * n : (n + 1) ** 2]) for n in range(degree + 1)]
            assert (np.array(norms) <= bounds[order, 0] * 1.01).all()


def test_no_held_out_place_is_below_the_certificate(ball):
    drives = random_drives(3, 9, torch.Generator().manual_seed(0))
    shifts = RADIUS * np.concatenate(
        [in_ball(200, np.random.default_rng(1)), in_ball(200, np.random.default_rng(2), surface=True)]
    )
    matrices = ball.transfer_matrix(shifts)
    goal = at.WeakestFocus([1.0, 2.0])
    for drive in drives:
        certificate = ball.certificate(drive, goal)
        scores = goal((matrices @ drive).abs())
        assert certificate.least <= scores.min()
        assert certificate.worst <= scores.min() * 1.001  # the search met a place as bad
        assert certificate.least >= 0.99 * certificate.worst or certificate.worst < 0.05 * scores.max()


def test_a_robust_drive_holds_where_the_nominal_one_does_not(ball):
    nominal = at.gradient_ascent(ball.transfer_matrix((0.0, 0.0, 0.0))).drive[0]
    robust = at.robust_drive(ball, rounds=6)
    before = ball.certificate(nominal)
    assert before.least < robust.certificate.least <= robust.certificate.worst <= robust.bound
    assert robust.nominal == pytest.approx(
        float((ball.transfer_matrix((0.0, 0.0, 0.0)) @ robust.drive).abs().amin())
    )
    assert robust.certificate.offsets.norm(dim=1).max() <= RADIUS * (1 + 1e-9)


def test_spheres_whose_waves_do_not_converge_have_no_certificate(balls):
    nearly_touching = tuple(at.Sphere((x, 0, 40e-3), 8e-3, rigid=True) for x in (-8.005e-3, 8.005e-3))
    near = at.make_propagator(replace(balls.scene, obstacles=nearly_touching), "tmatrix", tolerance=1e-4)
    with pytest.raises(ValueError, match=r"propagator: .*waves that converge"):
        at.PoseBall(near, RADIUS).certificate(torch.ones(9) + 0j)


def test_wrong_balls_are_named(balls, ball):
    with pytest.raises(ValueError, match="radius: 0"):
        at.PoseBall(balls, 0)
    with pytest.raises(ValueError, match=r"radius: .*must leave points .* away"):
        at.PoseBall(balls, 25e-3).certificate(torch.ones(9) + 0j)
    with pytest.raises(ValueError, match=r"drive: shape \(2, 9\)"):
        ball.certificate(torch.ones(2, 9) + 0j)
    with pytest.raises(ValueError, match=r"goal: .*WeakestFocus"):
        ball.certificate(torch.ones(9) + 0j, at.MeanPressure())
    free = at.make_propagator(replace(balls.scene, obstacles=()))
    with pytest.raises(ValueError, match=r"propagator: .*TMatrixPropagator"):
        at.PoseBall(free, RADIUS)
    floor = at.Reflector((0, 0, 0.1), (0, 0, -1))
    with pytest.raises(ValueError, match="without reflectors"):
        at.PoseBall(at.make_propagator(replace(balls.scene, reflectors=(floor,)), "tmatrix"), RADIUS)
