"""Gor'kov's potential, force and stiffness of small particles."""

import math

import numpy as np
import pytest
import torch

import autdtorch as at
from autdtorch.scene.particle import GRAVITY

MEDIUM = at.Medium(density=1.204, sound_speed=343.0)
POINTS = [(0.001, 0.002, 0.05), (0.01, 0.0, 0.03)]


def scene(**others):
    array = at.TransducerArray.grid((4, 4), 10e-3, (0, 0, 0), (0, 0, 1), source_strength=1.0, radius=4.5e-3)
    return at.Scene(array, MEDIUM, 40e3, [(0, 0, 0.1)], **others)


def drive(seed=0):
    phases = (
        2 * math.pi * torch.rand(2, 16, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    )
    return at.drive_from_phases(phases)


def relative(value, expected):
    return float(((value - expected).norm() / expected.norm()).detach())


@pytest.mark.parametrize("bodies", [(), (at.Sphere((0.03, 0, 0.06), 8e-3, rigid=True),)])
def test_force_and_stiffness_are_derivatives_of_the_potential(bodies):
    propagator = at.make_propagator(
        scene(obstacles=bodies), "tmatrix" if bodies else "free_space", tolerance=1e-9
    )
    points = torch.tensor(POINTS, dtype=torch.float64, requires_grad=True)
    field = at.gorkov(propagator, points, drive())
    (slope,) = torch.autograd.grad(field.potential[0].sum(), points, retain_graph=True)
    assert relative(-slope, field.force[0]) < 1e-8
    each = [torch.autograd.grad(-field.force[0, :, i].sum(), points, retain_graph=True)[0] for i in range(3)]
    assert relative(torch.stack(each, dim=1), field.stiffness[0]) < 1e-7


@pytest.mark.filterwarnings("ignore::autdtorch.ScaleWarning")  # of transducers so far apart
def test_a_standing_wave_holds_a_bead_as_theory_says():
    # 2 A cos(k z) from two far transducers: F = 4 pi a^3 k E Phi sin(2 k z), E = A^2 / (rho c^2) (Bruus 2012)
    far, k = 0.3, 2 * math.pi * 40e3 / 343
    array = at.TransducerArray(
        [(0, 0, -far), (0, 0, far)], normals=[(0, 0, 1), (0, 0, -1)], source_strength=1.0
    )
    propagator = at.make_propagator(at.Scene(array, MEDIUM, 40e3, [(0, 0, 0.1)]), "free_space")
    bead, z = at.Particle.of("EPS", 0.4e-3), torch.linspace(-4e-3, 4e-3, 9, dtype=torch.float64)
    points = torch.stack([0 * z, 0 * z, z], dim=1)
    field = at.gorkov(propagator, points, torch.ones(2, dtype=torch.complex128), bead)
    f1, f2 = bead.contrasts(MEDIUM)
    energy = (1.0 / far) ** 2 / (1.204 * 343**2)
    force = 4 * math.pi * bead.radius**3 * k * energy * (f1 / 3 + f2 / 2) * torch.sin(2 * k * z)
    assert (
        field.force[:, 2] - force
    ).abs().max() < 0.02 * force.abs().max()  # spherical waves: 1 / (k far) is 0.5 %
    weighted = at.gorkov(propagator, points, torch.ones(2, dtype=torch.complex128), bead, up=(0, 0, 1))
    assert torch.allclose(
        field.force[:, 2] - weighted.force[:, 2], torch.full((9,), bead.weight, dtype=torch.float64)
    )
    assert bead.weight == pytest.approx(4 / 3 * math.pi * 0.4e-3**3 * 29.36 * GRAVITY)


@pytest.mark.parametrize("material", ["EPS", "water"])
@pytest.mark.parametrize("size", [0.05, 0.2, 0.4])
def test_the_force_approaches_that_on_a_sphere_as_the_square_of_its_size(material, size):
    bead = at.Particle.of(material, size * 343 / (2 * math.pi * 40e3))
    fluid = {"density": bead.density, "sound_speed": bead.sound_speed}
    sphere = at.TMatrix.of(at.Sphere(POINTS[0], bead.radius, **fluid), MEDIUM, 40e3, error=1e-8)
    above = at.TransducerArray.grid((4, 4), 10e-3, (5e-3, 0, 0.1), (0, 0, -1), source_strength=1.0)
    below = scene().array
    places, normals = (
        torch.cat([getattr(each, name) for each in (below, above)]) for name in ("positions", "normals")
    )
    array = at.TransducerArray(places, normals, source_strength=1.0)
    propagator = at.make_propagator(at.Scene(array, MEDIUM, 40e3, [(0, 0, 0.1)]), "free_space")
    both = torch.cat([drive(0), drive(1)], dim=-1)
    exact = at.radiation_force(sphere, both, array=array, medium=MEDIUM)
    force = at.gorkov(propagator, POINTS[:1], both, bead).force[:, 0]
    assert relative(force, exact) < size**2  # about half of it


def test_a_box_gives_the_force_of_the_t_matrix():
    sphere = at.Sphere((0.005, 0, 0.04), 6e-3, rigid=True)
    exact, box = (
        at.make_propagator(scene(obstacles=[sphere]), method, spacing=1.5e-3, tolerance=1e-2)
        for method in ("tmatrix", "box")
    )
    bead, points = at.Particle.of("EPS", 0.5e-3), [(0.0, 0.002, 0.06)]
    fields = [at.gorkov(propagator, points, drive()[0], bead) for propagator in (exact, box)]
    # pressures of this coarse box err by 3 %, and derivatives by more
    assert relative(fields[1].force, fields[0].force) < 0.15
    assert relative(fields[1].stiffness, fields[0].stiffness) < 0.15


def test_points_and_particles_out_of_range_are_named():
    near = at.make_propagator(scene(obstacles=[at.Sphere((0, 0, 0.05), 5e-3, rigid=True)]), "tmatrix")
    bead = at.Particle.of("water", 0.5e-3)
    with pytest.raises(ValueError, match=r"points\[0\]: .* must be at least 2.05 mm from obstacles\[0\]"):
        at.gorkov(near, [(0, 0, 0.0565)], drive(), bead)
    with pytest.raises(ValueError, match=r"at least 2\.05 mm from the array"):
        at.gorkov(near, [(0.005, 0.005, 0.001)], drive(), bead)
    with pytest.warns(at.ScaleWarning, match=r"its radius is 0\.23 wavelengths"):
        at.gorkov(near, [(0, 0, 0.1)], drive(), at.Particle.of("EPS", 2e-3))
    with pytest.raises(ValueError, match="material: 'lead'; must be one of"):
        at.Particle.of("lead", 1e-3)
    assert np.isfinite(at.Particle.of("water", 1e-3).weight)


def test_without_sound_there_is_no_place_of_equilibrium():
    propagator = at.make_propagator(scene(), "free_space")
    field = at.gorkov(propagator, POINTS, 0 * drive(), at.Particle.of("EPS", 0.5e-3), up=(0, 0, 1))
    with pytest.raises(ValueError, match=r"stiffness\[0, 0\]: .* N/m; must not be 0 along any direction"):
        field.displacement.norm()
    figure = at.plot_force(
        torch.zeros(2, 2, 3), torch.ones(4, 4), at.Plane((0, 0, 0), (1, 0, 0), (4e-3, 4e-3))
    )
    assert figure.axes


def test_what_inference_mode_computes_first_serves_gradients_later():
    array = at.TransducerArray.grid((2, 2), pitch=10e-3, center=(0, 0, 0), normal=(0, 0, 1))
    scene = at.Scene(array, MEDIUM, 39_876.5, POINTS)  # a frequency of its own, whose maps no test has made
    free = at.make_propagator(scene)
    drive = torch.ones(4, dtype=torch.complex128)
    with torch.inference_mode():
        force = at.gorkov(free, POINTS, drive).force
    again = at.gorkov(free, POINTS, drive.requires_grad_()).force
    again.sum().backward()
    assert torch.equal(again.detach(), force)
    assert drive.grad.norm() > 0
