"""Spherical waves: harmonics, sources, translations and coefficients of spheres, and their derivatives."""

import cmath
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import sph_harm_y
from small_scenes import relative_error

import autdtorch as at
from autdtorch.analytic.mean_waves import MeanWaves, powers_needed
from autdtorch.analytic.spherical_waves import (
    degrees,
    harmonics,
    mirrored,
    outgoing_waves,
    regular_waves,
    sphere_coefficients,
)
from autdtorch.propagators.tmatrix.obstacle_groups import enough_degrees
from autdtorch.propagators.tmatrix.translation import Translation, WaveFrame
from autdtorch.scene.geometry import composed_rotation, rotation_matrix

WAVENUMBER = 2 * math.pi * 40e3 / 340.0


def unit_vectors(count: int) -> torch.Tensor:
    directions = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return directions / directions.norm(dim=1, keepdim=True)


def test_harmonics_are_those_of_scipy():
    directions = torch.cat([unit_vectors(20), torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]).double()])
    polar, azimuth = torch.acos(directions[:, 2]), torch.atan2(directions[:, 1], directions[:, 0])
    order = [(degree, m) for degree in range(16) for m in range(-degree, degree + 1)]
    for place, (degree, m) in enumerate(order):
        exact = sph_harm_y(degree, m, polar.numpy(), azimuth.numpy())
        np.testing.assert_allclose(harmonics(15, directions)[:, place].numpy(), exact, rtol=0, atol=1e-12)
    place, sign = mirrored(15)
    for here, (degree, m) in enumerate(order):
        assert (int(degrees(15)[here]), order[int(place[here])], float(sign[here])) == (
            degree,
            (degree, -m),
            (-1) ** m,
        )


@pytest.mark.parametrize("wavenumber", [WAVENUMBER, complex(WAVENUMBER, 3.0)])
@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.3, -0.5, 0.8)])
def test_means_of_waves_over_discs_are_those_over_their_nodes(wavenumber, normal):
    discs = at.TransducerArray.grid((2, 3), 10e-3, (0.0, 0.0, 0.0), normal, radius=4.5e-3)
    axes, center = rotation_matrix((0.3, -0.2, 0.5)), torch.tensor([30e-3, 2e-3, -1e-3]).double()
    places, weights = discs.nodes
    waves = outgoing_waves(12, wavenumber, (places - center) @ axes, conjugate=True)
    expected = torch.einsum("mnk,n->mk", waves, weights.to(torch.complex128))
    offsets = discs.positions - center
    powers = powers_needed(12, wavenumber, float(offsets.norm(dim=1).min()) - 4.5e-3, 4.5e-3)
    means = MeanWaves.of(12, wavenumber, offsets, discs.normals[0], 4.5e-3, axes, powers)
    errors = (means.matrix - expected).norm(dim=0) / expected.norm(dim=0)
    assert errors.max() < 1e-7  # of the nodes, for waves of high degrees at this distance
    weights = torch.randn(2, 169, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
    assert relative_error(means.weighted(weights), weights @ means.matrix.mT) < 1e-12  # rounding


def test_a_series_for_a_disc_next_to_the_centre_takes_too_many_powers():
    assert powers_needed(12, WAVENUMBER, 80e-3, 4.5e-3) <= 12
    assert powers_needed(12, WAVENUMBER, 2e-3, 4.5e-3) is None


@pytest.mark.parametrize("wavenumber", [WAVENUMBER, complex(WAVENUMBER, 3.0)])
def test_waves_add_up_to_a_point_source(wavenumber):
    near, far = 8e-3 * unit_vectors(5), 30e-3 * unit_vectors(10)[5:]
    regular, outgoing = (
        regular_waves(40, wavenumber, near),
        outgoing_waves(40, wavenumber, far, conjugate=True),
    )
    distance = (near - far).norm(dim=1)
    exact = torch.exp(1j * wavenumber * distance) / distance
    assert relative_error(4j * math.pi * wavenumber * (regular * outgoing).sum(dim=1), exact) < 1e-10


@pytest.mark.parametrize(("wavenumber", "conjugate"), [(WAVENUMBER, False), (complex(WAVENUMBER, 3.0), True)])
def test_derivatives_of_outgoing_waves_are_those_of_finite_differences(wavenumber, conjugate):
    def waves(lengths: torch.Tensor) -> torch.Tensor:  # in units of 1 / k
        return outgoing_waves(3, wavenumber, lengths / WAVENUMBER, conjugate)

    offsets = (4 * unit_vectors(3)).requires_grad_(True)
    assert torch.autograd.gradcheck(waves, offsets, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(waves, offsets, fast_mode=True)


@pytest.mark.parametrize(("degree", "distance", "mirrored_axes"), [(0, 0.02, False), (3, 0.05, True)])
def test_waves_around_one_centre_are_waves_around_another(degree, distance, mirrored_axes):
    generator = torch.Generator().manual_seed(degree)
    axes, other_axes = (
        rotation_matrix(tuple(torch.randn(3, generator=generator).tolist())) for _ in range(2)
    )
    if mirrored_axes:  # of a body's image
        other_axes = other_axes * other_axes.new_tensor([1.0, -1.0, 1.0])
    shift = torch.nn.functional.normalize(torch.randn(3, generator=generator).double(), dim=0) * distance
    near = distance / 20 * unit_vectors(4)
    outgoing = outgoing_waves(degree, WAVENUMBER, (near + shift) @ other_axes)
    frames = WaveFrame(shift[None], axes[None], 15), WaveFrame(0 * shift[None], other_axes[None], degree)
    each = torch.eye((degree + 1) ** 2, dtype=torch.complex128)
    moved = Translation(WAVENUMBER, *frames).applied(each[:, None])[:, 0]
    regular = regular_waves(15, WAVENUMBER, near @ axes)
    # higher degrees are left out: j_16(k r) / j_3(k r) is below 1e-10 at r = 2.5 mm
    assert relative_error(regular @ moved, outgoing) < 1e-9


def test_derivatives_of_translations_are_those_of_finite_differences():
    mirror, random = torch.eye(3).double() * torch.tensor([1.0, -1.0, 1.0]), torch.Generator().manual_seed(0)

    def moved(waves: torch.Tensor, *poses: torch.Tensor) -> torch.Tensor:  # lengths in units of 1 / k
        shift, other_shift, *angles = poses
        axes, other_axes = (composed_rotation(each.cos(), each.sin()) for each in angles)
        frames = (
            WaveFrame(shift / WAVENUMBER, axes @ mirror, 2),
            WaveFrame(other_shift / WAVENUMBER, other_axes, 3),
        )
        return Translation(WAVENUMBER, *frames).applied(waves)

    waves = torch.randn(16, 2, 2, dtype=torch.complex128, generator=random)
    poses = [torch.randn(2, 3, dtype=torch.float64, generator=random) for _ in range(4)]
    poses[0] += 10
    arguments = [each.requires_grad_(True) for each in (waves, *poses)]
    assert torch.autograd.gradcheck(moved, arguments, fast_mode=True)
    assert torch.autograd.gradgradcheck(moved, arguments, fast_mode=True)


def test_coefficients_conserve_energy_and_degrees_suffice():
    for ratios in ((), (3.0, 0.7), (1e4, 5.0)):
        coefficients = sphere_coefficients(20, 6.0, *ratios)
        assert np.abs(1 + 2 * coefficients) == pytest.approx(np.ones(21), abs=1e-12)
    # j_l in a stiff sphere is below the smallest number; it is nearly rigid
    stiff, rigid = sphere_coefficients(170, 150.0, 1e5, 2941.0), sphere_coefficients(170, 150.0)
    assert np.abs(stiff - rigid).max() < 1e-3
    for size in (1.0, 6.0, 15.0):
        enough = enough_degrees(size, 1e-3)
        assert abs(sphere_coefficients(enough + 1, size)[-1]) < 1e-3


@given(
    st.floats(0.3, 20),
    st.floats(1e-3, 1e4),
    st.floats(0, 0.999),
    st.floats(1e-3, 1e3),
    st.floats(0, 0.999),
    st.floats(0.5, 90),
)
def test_coefficients_of_spheres_that_absorb_are_passive(size, density, dense, stiffness, stiff, angle):
    """Density in the first quadrant, bulk modulus in the fourth; and impedances in the right half-plane."""
    density = cmath.rect(density, dense * math.pi / 2)
    modulus = cmath.rect(stiffness, -stiff * math.pi / 2)
    fluid = sphere_coefficients(30, size, density, complex(cmath.sqrt(modulus / density)))
    surface = sphere_coefficients(30, size, impedance=cmath.rect(stiffness, math.radians(2 * angle - 90)))
    for coefficients in (fluid, surface):
        assert (np.abs(1 + 2 * coefficients) < 1 + 1e-9).all()  # rounding at resonances
