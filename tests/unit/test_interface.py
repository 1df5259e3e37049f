"""Interface elements: planes and spheres through the cube between eight cell centres, and their forces.

In units of a cell and of air. Materials of which one has a mass and the other none show where mass goes.
"""

import math

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from autdtorch.fdtd.assembly.interface import Bodies, interface_elements
from autdtorch.fdtd.assembly.reference_element import (
    CORNERS,
    FAR,
    LATTICE,
    PAIRS,
    SUBCELLS,
    VERTICES,
    Materials,
    stiffness_matrix,
    uniform_coupling,
)
from autdtorch.fdtd.assembly.smooth_faces import face_forces, fields, forces, smooth_stiffness, surfaces
from autdtorch.fdtd.assembly.thin_walls import Side, wall_sides
from autdtorch.fdtd.stencil import tuned_stencil

STENCIL = tuned_stencil(2 * math.pi / 8.5)
LONG = tuned_stencil(1e-3)  # of long waves: the terms of second order are 1e-6
ONE = np.array([1])
OFFSETS = st.floats(-0.4, 0.4)
CONTRASTS = st.floats(-3, 5).map(lambda exponent: 10**exponent)
OPEN = (Side(np.ones((1, SUBCELLS**3)), np.zeros((1, 8), bool)),)  # without walls
NORMALS = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda n: np.linalg.norm(n) > 0.1)


def plane(normal, offset):
    """Distance from a plane that passes the middle of the element at `offset`."""
    return np.asarray((LATTICE - 0.5) @ normal / np.linalg.norm(normal) - offset)


def sphere(normal, offset, radius):
    """Distance from a sphere whose nearest point to the middle of the element is at `offset`."""
    center = 0.5 + (offset - radius) * normal / np.linalg.norm(normal)
    return np.asarray(np.linalg.norm(LATTICE - center, axis=1) - radius)


def element(*distance, density=(1, 77), mass=None, stencil=STENCIL):
    """One element, obstacle k of which is of material k + 1; masses are 1/density by default."""
    masses = np.array(mass or [1 / d for d in density], float)
    materials = Materials(
        np.array(density, float), masses, np.ones(len(density)), np.zeros(len(density), bool)
    )
    count = len(distance)
    numbers, none = np.arange(count) + 1, np.zeros(count, bool)
    near = Bodies(np.stack(distance)[:, None], numbers, none[:, None], np.zeros((1, 3, 3)), none[:1], OPEN)
    return interface_elements(near, materials, stencil)


def rigid_element(distance, reduction=0.0, sides=OPEN):
    """One element that a tilted rigid surface cuts."""
    materials = Materials(np.array([1, 1e5]), np.array([1, 1e-5]), np.ones(2), np.array([False, True]))
    reductions = np.broadcast_to(reduction, (1, 3, 3))
    near = Bodies(distance[None, None], ONE, ONE[None] > 0, reductions, reductions.any(axis=(1, 2)), sides)
    return interface_elements(near, materials, STENCIL)


def energy(cut, field):
    """Energy of a field (8,) at the vertices: the integral of |gradient|^2 / density."""
    return float(field @ stiffness_matrix(cut.coupling)[0] @ field)


@pytest.mark.parametrize("density", [1e-3, 1.0, 1e5])
def test_an_element_of_one_material_is_the_tuned_stencil_over_its_density(density):
    inside = np.full(len(LATTICE), -FAR)
    cut = element(inside, density=(1, density))
    # rounding
    assert np.allclose(cut.coupling, uniform_coupling(STENCIL) / density, rtol=1e-14)
    assert np.allclose(cut.mass, 1 / (8 * density), rtol=1e-14)
    assert np.allclose(element(-inside).coupling, uniform_coupling(STENCIL), rtol=1e-14)


def test_eight_elements_of_air_add_up_to_the_tuned_stencil():
    matrix = stiffness_matrix(uniform_coupling(STENCIL)[None])[0]
    sums = np.zeros((3, 3, 3))
    for one, vertex in enumerate(VERTICES):
        for other, target in enumerate(VERTICES):
            sums[tuple(target - vertex + 1)] -= matrix[one, other]
    sums[1, 1, 1] = 0
    assert np.allclose(sums.ravel(), STENCIL.weights, rtol=1e-14)


@settings(max_examples=60)
@given(NORMALS, OFFSETS, CONTRASTS, st.one_of(st.none(), st.floats(1, 30)))
def test_energy_is_never_negative_at_any_contrast(normal, offset, density, radius):
    distance = plane(normal, offset) if radius is None else sphere(normal, offset, radius)
    matrix = stiffness_matrix(element(distance, density=(1, density)).coupling)[0]
    size = np.abs(matrix).max()
    # rounding of sums of terms up to the contrast apart
    assert np.linalg.eigvalsh(matrix).min() > -1e-11 * size
    assert np.abs(matrix @ np.ones(8)).max() < 1e-12 * size


# Between these, forces replace energies: they are exact only in sum over all elements of a surface
LARGE_CONTRASTS = st.floats(2.3, 5).flatmap(lambda exponent: st.sampled_from((10**-exponent, 10**exponent)))


@settings(max_examples=60)
@given(NORMALS, OFFSETS, LARGE_CONTRASTS)
def test_a_field_along_a_plane_surface_has_its_exact_energy(normal, offset, density):
    cut = element(plane(normal, offset), density=(1, density), stencil=LONG)
    volumes = element(plane(normal, offset), density=(1, density), mass=(0, 1)).mass.sum()
    assume(1e-3 < volumes < 1 - 1e-3)  # what is smaller may count as absent
    along = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    along /= np.linalg.norm(along)
    # 1/density averaged over the element, which is what its masses sum to
    assert energy(cut, VERTICES @ along) == pytest.approx(cut.mass.sum(), rel=1e-5)


TILTED = NORMALS.filter(lambda n: np.count_nonzero(np.abs(n) > 0.01) > 1)


@settings(max_examples=60)
@given(TILTED, OFFSETS, st.floats(0, 0.45))
def test_a_tilted_rigid_surface_leaves_the_energy_of_the_air(normal, offset, reduction):
    cut = rigid_element(plane(normal, offset))
    air = float(cut.mass.sum())
    for direction in np.eye(3):
        assert energy(cut, VERTICES @ direction) == pytest.approx(air, rel=1e-9)  # rounding
    middle = cut.mass[0] @ VERTICES / air
    assert ((middle > 0) & (middle < 1)).all()
    edge = normal / np.linalg.norm(normal)
    softer = rigid_element(plane(normal, offset), reduction * (np.eye(3) - np.outer(edge, edge)))
    assert energy(softer, VERTICES @ edge) == pytest.approx(air, rel=1e-9)
    across = np.cross(edge, np.eye(3)[np.abs(edge).argmin()])
    across /= np.linalg.norm(across)
    assert energy(softer, VERTICES @ across) == pytest.approx((1 - reduction) * air, rel=1e-9)
    assert np.linalg.eigvalsh(stiffness_matrix(softer.coupling)[0]).min() > -1e-12


@pytest.mark.parametrize("axis", [0, 1, 2])
@given(offset=OFFSETS, density=CONTRASTS)
def test_a_flow_through_a_surface_along_the_grid_meets_its_exact_resistance(axis, offset, density):
    normal = np.eye(3)[axis]
    depth = VERTICES[:, axis] - 0.5 - offset
    kinked = np.where(depth < 0, density, 1.0) * depth  # of unit flow
    cut = element(plane(normal, offset), density=(1, density), stencil=LONG)
    resistance = (0.5 + offset) * density + (0.5 - offset)
    flow = stiffness_matrix(cut.coupling)[0] @ kinked
    # nothing flows along the surface, all of it across
    assert flow[depth > 0].sum() == pytest.approx(1, rel=1e-5)
    assert energy(cut, kinked) == pytest.approx(resistance, rel=1e-5)


@settings(max_examples=40)
@given(TILTED, OFFSETS)
def test_masses_follow_the_flow(normal, offset):
    distance = plane(normal, offset)
    for density in (77.0, 1e9):
        air, solid = (element(distance, density=(1, density), mass=mass) for mass in ((1, 0), (0, 1)))
        assert air.mass.sum() + solid.mass.sum() == pytest.approx(1, rel=1e-12)
        assert min(air.mass.min(), solid.mass.min()) >= 0
        inside = solid.material[0] == 1
        if density == 1e9 and inside.any():  # all air is before the surface; slivers of 1e-4 hardly resist
            assert air.mass[0, inside].sum() <= 1e-4 * air.mass.sum() or solid.mass.sum() < 1e-4


@settings(max_examples=40)
@given(TILTED, OFFSETS, st.floats(1, 30))
def test_a_surface_within_one_material_leaves_its_masses(normal, offset, radius):
    for distance in (plane(normal, offset), sphere(normal, offset, radius)):
        cut = element(distance, density=(1, 1), mass=(1, 1))
        assert cut.mass[0] == pytest.approx(np.full(8, 1 / 8), rel=1e-9)  # rounding


@pytest.mark.parametrize("offset", [-0.6, -0.2, 0.1, 0.5])
def test_volumes_of_planes(offset):
    along, share = element(plane(np.array((0, 1, 0)), offset), stencil=LONG), max(0, 0.5 + offset)
    assert along.mass.sum() == pytest.approx(1 - share + share / 77, rel=1e-5)
    normal, points = np.array((0.8, 0.5, 0.33)), np.random.default_rng(0).random((400_000, 3))
    exact = ((points - 0.5) @ normal / np.linalg.norm(normal) < offset).mean()
    # random points are good to 8e-4; the sub-cells of a quarter to 1 % (measured)
    cut = element(plane(normal, offset), mass=(0, 1), stencil=LONG)
    assert cut.mass.sum() == pytest.approx(exact, abs=0.012)


def test_of_two_obstacles_the_later_wins_and_touching_ones_leave_no_air():
    lower, deeper = plane(np.array((1, 0, 0)), 0.3), plane(np.array((1, 0, 0)), -0.1)
    tilted, other = plane(np.array((0.6, 0.0, 0.8)), 0.1), plane(-np.array((0.6, 0.0, 0.8)), -0.1)

    def share(first, second, material):
        return element(first, second, density=(1, 5, 9), mass=tuple(np.eye(3)[material])).mass.sum()

    for first, second, shares in ((lower, deeper, (0.2, 0.4, 0.4)), (deeper, lower, (0.2, 0.0, 0.8))):
        cut = element(first, second, density=(1, 5, 9), stencil=LONG)
        assert cut.mass.sum() == pytest.approx(np.array(shares) @ (1, 1 / 5, 1 / 9), rel=1e-5)
    assert share(tilted, other, 0) == pytest.approx(0, abs=1e-12)  # no air where bodies touch


@pytest.mark.parametrize("thickness", [0.01, 0.1, 0.5])
def test_a_plate_thinner_than_a_cell_between_the_vertices_is_there(thickness):
    density = 50.0
    plate = np.abs(LATTICE[:, 0] - 0.46) - thickness / 2
    cut = element(plate, density=(1, density), stencil=LONG)
    assert not cut.material.any()
    assert cut.mass.sum() == pytest.approx(1 - thickness + thickness / density, rel=1e-5)
    # a flow across it meets the resistance of both
    resistance = 1 + (density - 1) * thickness
    assert energy(cut, VERTICES[:, 0].astype(float)) == pytest.approx(1 / resistance, rel=1e-5)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_face_through_vertices_is_corrected_from_either_side(side):
    """All of one material, four vertices of which count to the other."""
    density = 77.0
    distance = LATTICE[:, 0] - 1 if side < 0 else LATTICE[:, 0] - 1e-9
    cut = element(distance, density=(1, density))
    assert set(cut.material[0]) == {0, 1}
    mobility = 1 / density if side < 0 else 1.0
    # the sliver of 1e-9, and rounding
    assert energy(cut, VERTICES[:, 1].astype(float)) == pytest.approx(mobility, rel=1e-6)


@given(st.integers(0, 2), st.floats(-0.5, 0.5), CONTRASTS, st.booleans())
def test_a_face_along_the_grid_has_a_positive_energy_in_every_direction(axis, offset, contrast, behind):
    """Otherwise absorbing layers that it enters give energy.

    Two elements in a row represent the rest of each material; along the face there is a wave of the grid.
    """
    normal = (-1.0 if behind else 1.0) * np.eye(3)[axis]
    cut = element(plane(normal, offset), density=(1, contrast))
    air = uniform_coupling(STENCIL)
    low, high = (air, air / contrast) if behind else (air / contrast, air)
    chain = [stiffness_matrix(one[None])[0] for one in (low, low, cut.coupling[0], high, high)]
    for first in np.linspace(0, np.pi, 5):
        for second in np.linspace(0, np.pi, 5):
            along = _energy_along(chain, axis, np.array((first, second)))
            # rounding, relative to the stiffer side
            assert np.linalg.eigvalsh(along).min() > -1e-9 * max(1, 1 / contrast)


def _energy_along(chain, axis, wave):
    """Energy of elements in a row for a wave (2,) along the face, less that without its first component."""
    sides = [other for other in range(3) if other != axis]
    matrices = []
    for turned in (wave, wave * (0, 1)):
        matrix = np.zeros((len(chain) + 1, len(chain) + 1), complex)
        phase = np.exp(1j * VERTICES[:, sides] @ turned)
        for place, one in enumerate(chain):
            waved = phase.conj()[:, None] * one * phase[None, :]
            level = VERTICES[:, axis] + place
            np.add.at(matrix, (level[:, None], level[None, :]), waved)
        matrices.append(matrix)
    return matrices[0] - matrices[1]


def planes(ratio, normal, depth):
    """Return flat surfaces with normals (n, 3), at a signed distance (n,) from the centres."""
    level = depth[:, None] + normal @ (LATTICE - 0.5).T
    _, surface = surfaces(level, np.tile((1.0, ratio), (len(depth), 1)))
    return surface


def random_planes(ratio):
    random = np.random.default_rng(1)
    normal = random.normal(size=(200, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return planes(ratio, normal, random.uniform(-0.5, 0.5, 200))


RATIOS = pytest.mark.parametrize("ratio", [0.14, 1.5, 8.0, 77.0])


@RATIOS
def test_elements_sharing_a_face_get_opposite_forces(ratio):
    """No net force at the vertices of flat surfaces, for all fields along the surface and across it."""
    here = random_planes(ratio)
    middle = here.level[:, len(LATTICE) // 2]
    for axis in range(3):
        beyond = planes(ratio, here.normal, middle + here.normal[:, axis])
        assert np.allclose(face_forces(here, 2 * axis + 1), -face_forces(beyond, 2 * axis), atol=1e-11)


@RATIOS
def test_stiffness_gives_the_fields_their_forces(ratio):
    here = random_planes(ratio)
    uniform, mobility = np.full(28, 0.1), np.full((200, 64), 1 / 64)
    coupling, weight = smooth_stiffness(here, mobility, np.tile(uniform, (200, 1)), uniform)
    assert (weight == 1).mean() > 0.99  # the others' energy would not be positive
    matrix, local, force = stiffness_matrix(coupling), fields(here), forces(here)
    forced = weight == 1
    assert np.allclose((matrix @ local)[forced], force[forced], atol=1e-9)
    assert np.linalg.eigvalsh(matrix).min() > -1e-9


def test_in_one_material_forces_are_those_of_linear_pressures():
    here = random_planes(1.0)
    slope = np.concatenate((here.tangents, here.normal[:, None]), axis=1)
    at_vertices = np.array(list(np.ndindex((2,) * 3))) - 0.5
    # half of the flow through each face that a vertex touches: a quarter of it, from each of three faces
    assert np.allclose(forces(here), at_vertices @ slope.transpose(0, 2, 1) / 2, atol=0.01)


@example(np.array((1.0, 0.5, 0.5)), 0.5, 0.375)
@given(NORMALS, st.floats(-0.8, 0.8), st.floats(0.35, 2.0))
def test_a_thin_wall_parts_the_air_in_front_from_the_air_behind(normal, offset, thickness):
    middle = plane(normal, offset)
    level = np.abs(middle) - thickness / 2
    assume((level < 0).any() and (level > 0.02).any())
    nearest = np.sign(middle[CORNERS])[None, :, None] * normal / np.linalg.norm(normal)
    sides = wall_sides(level[None], nearest, np.ones(1, bool))
    cut = rigid_element(level, sides=sides)
    front = middle[CORNERS] > 0
    across = front[PAIRS[:, 0]] != front[PAIRS[:, 1]]
    # along the grid, that of rigid bodies; at an angle, 4.3e-3 at most in 3,000 walls of 0.35 to 0.41 cells,
    # in sub-cells that both sides enter
    assert np.abs(cut.coupling[0, across]).sum() < (1e-4 if thickness > 0.45 else 0.01)
    assert np.linalg.eigvalsh(stiffness_matrix(cut.coupling))[0, 0] > -1e-12
    assert cut.mass.sum() == pytest.approx(rigid_element(level).mass.sum(), rel=1e-12)
