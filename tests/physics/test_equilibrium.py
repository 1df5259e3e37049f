"""The place where a bead rests: the force there is 0, with all waves between it and the bodies."""

from dataclasses import replace

import pytest
import torch

import autdtorch as at

AIR = at.Medium(density=1.204, sound_speed=343.0)
POINT, UP = (0.001, 0.002, 0.03), (0.0, 0.0, 1.0)
BALL = at.Sphere((0.008, 0.002, 0.026), 3e-3, rigid=True)


def propagator(bodies=(), points=((0, 0, 0.1),)):
    array = at.TransducerArray.grid((4, 4), 10e-3, (0, 0, 0), (0, 0, 1), source_strength=20.0)
    method = "tmatrix" if bodies else "free_space"
    return at.make_propagator(at.Scene(array, AIR, 40e3, points, bodies), method, tolerance=1e-5)


def trap(simulated, bead):
    """A drive that holds a bead near the point, with a little more lift there than its weight."""
    objective = at.ForceObjective(simulated, at.Levitate([POINT], particle=bead))
    drive = at.gradient_ascent(objective, starts=1).drive[0]
    lift = at.equilibrium(simulated, drive, bead, POINT).force[2] / bead.weight
    return drive * (1.1 / lift).sqrt()


def test_a_small_bead_rests_where_gorkov_says():
    bead, simulated = at.Particle.of("EPS", 0.05e-3), propagator()
    drive = trap(simulated, bead)
    rest = at.equilibrium(simulated, drive, bead, POINT, up=UP)
    field = at.gorkov(simulated, rest.place[None], drive, bead, up=UP)
    assert rest.holds
    # ka is 0.04: its cube is the share of the force by scattering, which is a few times the weight here
    assert field.force[0].norm() < 0.1 * bead.weight
    torch.testing.assert_close(rest.principal_stiffness, field.principal_stiffness[0], rtol=0.1, atol=0)
    sound = at.equilibrium(simulated, drive, bead, POINT)
    assert (sound.force - rest.force).tolist() == pytest.approx([0, 0, bead.weight], abs=1e-15)
    assert sound.place[2] > rest.place[2]  # its weight makes it sag


def test_beside_a_body_the_force_at_the_place_is_0():
    bead = at.Particle.of("EPS", 1e-3)
    simulated = propagator((BALL,))
    drive = trap(simulated, bead)
    rest = at.equilibrium(simulated, drive, bead, POINT, up=UP)
    material = {"density": bead.density, "sound_speed": bead.sound_speed}
    for place, force in ((POINT, rest.force), (rest.place.tolist(), torch.zeros(3).double())):
        both = propagator((BALL, at.Sphere(place, bead.radius, **material)))
        exact = at.radiation_force(both, drive, body=1) - torch.tensor([0, 0, bead.weight])
        assert (exact - force).norm() < 1e-4 * at.radiation_force(both, drive, body=1).norm()
    # Differences over 2 um err by (k 1e-6)^2, and by the force's 1e-6 over k 1e-6
    step, slopes = 1e-6, []
    for axis in torch.eye(3, dtype=torch.float64):
        shifted = [rest.place + sign * step * axis for sign in (1, -1)]
        ends = [at.equilibrium(simulated, drive, bead, place, up=UP) for place in shifted]
        slopes.append((ends[1].force - ends[0].force) / (2 * step))
    torch.testing.assert_close(
        rest.stiffness, torch.stack(slopes, dim=1), rtol=1e-3, atol=1e-3 * slopes[2].norm().item()
    )


def test_a_bead_that_falls_has_no_place():
    bead, simulated = at.Particle.of("EPS", 0.5e-3), propagator()
    drive = torch.zeros(16, dtype=torch.complex128)
    fallen = at.equilibrium(simulated, drive, bead, POINT, up=UP)
    assert fallen.place is None
    assert not fallen.holds
    assert fallen.force.tolist() == pytest.approx([0, 0, -bead.weight])
    assert not at.equilibrium(simulated, drive, bead, POINT).holds  # it floats, but nothing holds it
    low = (0.005, 0.005, 0.0012)  # over a transducer at z = 0, to which it falls
    assert at.equilibrium(simulated, drive, bead, low, up=UP).place is None


def test_what_cannot_be_is_refused_in_a_line():
    bead, drive = at.Particle.of("EPS", 1e-3), torch.ones(16, dtype=torch.complex128)
    simulated = propagator((BALL,))
    with pytest.raises(ValueError, match=r"point: \(.*\) m; must leave room for the sphere"):
        at.equilibrium(simulated, drive, bead, (0.008, 0.002, 0.0295))
    with pytest.raises(ValueError, match=r"point: \(.*\) m; must leave room .* and array"):
        at.equilibrium(simulated, drive, bead, (0.005, 0.005, 0.0009))
    box = at.make_propagator(replace(simulated.scene, domain=None), "box", spacing=2e-3)
    with pytest.raises(ValueError, match=r'propagator: .*; must be of method "tmatrix" or "free_space"'):
        at.equilibrium(box, drive, bead, POINT)
