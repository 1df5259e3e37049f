"""Stages of the assembly: materials, stiffness, masses, rigid cells; elements at faces and edges."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from autdtorch.fdtd.assembly.aligned import MaterialBlocks
from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import condensed, heterogeneous_cells
from autdtorch.fdtd.assembly.layered_elements import mean_air_thickness, two_port
from autdtorch.fdtd.assembly.prisms import prisms, stacked
from autdtorch.fdtd.assembly.reference_element import (
    VERTICES,
    InterfaceElements,
    stiffness_matrix,
    uniform_coupling,
)
from autdtorch.fdtd.assembly.sections import COLUMN_PAIRS, MaterialKey, Prisms, Section, plane_fields
from autdtorch.fdtd.assembly.unions import speed_factor
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.stability import fewest_steps, largest_eigenvalue
from autdtorch.fdtd.stencil import OFFSETS, tuned_stencil
from autdtorch.propagators.plan import region_of
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Sphere
from autdtorch.scene.scene import Medium, Scene

AIR = Medium(density=1.293, sound_speed=340.0)
STENCIL = tuned_stencil(2 * math.pi / 8.5)
GRID = Grid(1e-3, interior=(10, 10, 10), origin=(-6.5e-3,) * 3, kappa=STENCIL.kappa, layer_cells=6, path=0.0)
"""Cells of 1 mm whose interior fills a cube of 10 mm from the origin on."""

STRIDES = np.array((GRID.shape[1] * GRID.shape[2], GRID.shape[2], 1))


def material(ratio, speed=1.0):
    """Return a material by density, None for rigid, and sound speed relative to air."""
    if ratio is None:
        return {"rigid": True}
    return {"density": ratio * AIR.density, "sound_speed": speed * AIR.sound_speed}


def sphere(center, radius, ratio, speed=1.0):
    """In mm."""
    return Sphere(tuple(1e-3 * np.array(center)), 1e-3 * radius, **material(ratio, speed))


def box(low, high, ratio, speed=1.0, rotation=(0, 0, 0)):
    """Between two corners [mm]."""
    lower, upper = 1e-3 * np.array(low), 1e-3 * np.array(high)
    return Box(tuple((lower + upper) / 2), tuple(upper - lower), rotation=rotation, **material(ratio, speed))


def assembled(*obstacles):
    array = TransducerArray([[2e-3, -0.9, 0.0]], (1, 0, 0))
    scene = Scene(array, AIR, 40e3, [[2e-3, 0.9, 0.0]], obstacles, domain=((-1, -1, -1), (1, 1, 1)))
    elements = elements_of(region_of(scene), GRID, STENCIL)
    return elements, heterogeneous_cells(elements, STENCIL)


def mass_of_all(elements, cells):
    """Mass of every cell; unlisted cells have 1 at a surface, else the mass of their material."""
    mass = elements.materials.mass[np.pad(elements.material, ((1, 0),) * 3, mode="edge")].ravel()
    first = np.stack(np.unravel_index(elements.index, elements.material.shape), axis=-1)
    mass[(first[:, None] + VERTICES) @ STRIDES] = 1
    mass[cells.index] = cells.mass
    return mass


def test_speed_of_a_material_is_tuned_to_its_own_wavenumber():
    # frequency of a plane wave of that material's wavenumber, averaged over directions, is the drive's
    assert speed_factor(STENCIL, 1.0) == pytest.approx(1, rel=1e-14)
    slow = speed_factor(STENCIL, 0.5)
    assert slow * STENCIL.isotropic_symbol(2 * STENCIL.kappa) == pytest.approx(STENCIL.symbol)
    # (c / c_air)^2 apart from the grid's dispersion
    assert speed_factor(STENCIL, 4.0) == pytest.approx(16, rel=0.05)


@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_mass_of_elements_is_that_of_the_volume(speed):
    """Interface elements and uniform ones together; surfaces are moved by the mean thickness of a face."""
    radius = 2.7
    elements, _ = assembled(
        Sphere((5.1e-3, 4.8e-3, 5.3e-3), 1e-3 * radius, density=10 * AIR.density, sound_speed=speed * 340.0)
    )
    masses = elements.materials.mass[elements.material].ravel()
    masses[elements.index] = elements.interface.mass.sum(axis=1)[elements.kind]
    displaced = (1 - masses).sum() / (1 - elements.materials.mass[1])
    moved = radius + mean_air_thickness(elements.materials, STENCIL)[1]
    # sub-cells of a quarter: 0.2 % measured
    assert displaced == pytest.approx(4 / 3 * math.pi * moved**3, rel=5e-3)


@settings(max_examples=20)
@given(st.floats(0.01, 0.99), st.sampled_from([0.1, 3.0, 77.0, 1e5]), st.sampled_from([0.7, 1.0, 2.0]))
def test_no_mass_is_transferred_at_flat_faces_of_fluids(place, ratio, speed):
    """Waves are reflected exactly with the masses of the elements, and with no others."""
    elements, cells = assembled(box((-100, -100, 3 + place), (100, 100, 6.4), ratio, speed))
    uniform = np.repeat(elements.materials.mass[:, None] / 8, 8, axis=1)
    masses, mass = np.concatenate((uniform, elements.interface.mass)), np.zeros(GRID.shape)
    kind = elements.material.astype(np.int64)
    kind.ravel()[elements.index] = len(uniform) + elements.kind
    for number, vertex in enumerate(VERTICES):
        ends = (slice(first, first + size) for first, size in zip(vertex, kind.shape, strict=True))
        mass[tuple(ends)] += masses[kind, number]
    places = np.stack(np.unravel_index(cells.index, GRID.shape))
    faces = (np.abs(places[:2] - 11.5) < 2).all(axis=0)  # far from the box's edges
    assert faces.sum() >= 4 * 4 * 4
    assert cells.mass[faces] == pytest.approx(mass.ravel()[cells.index[faces]], rel=1e-12)


CENTERS = st.tuples(*[st.floats(4.5, 5.5)] * 3)


@settings(max_examples=5)
@given(CENTERS, st.floats(1.5, 2.5), st.sampled_from([0.1, 10.0, 77.0, 1e5]))
def test_mass_transfer_conserves_mass(center, radius, ratio):
    elements, cells = assembled(sphere(center, radius, ratio))
    of_elements = elements.materials.mass[elements.material].ravel()
    of_elements[elements.index] = elements.interface.mass.sum(axis=1)[elements.kind]
    # of the elements without the outermost half cell, which is air. The masses of some cells of the densest
    # fluid, 1e-5 each, are added to light cells with nothing to take around them.
    whole = of_elements.sum() + math.prod(GRID.shape) - math.prod(elements.material.shape)
    added = 1e-4 if ratio == 1e5 else 0.0
    assert mass_of_all(elements, cells).sum() == pytest.approx(whole, rel=1e-9, abs=added)


@settings(max_examples=5)
@given(CENTERS, st.floats(1.5, 2.5), st.sampled_from([None, 0.5, 77.0, 1e5]))
def test_bodies_of_any_place_take_little_of_the_time_step(center, radius, ratio):
    _, cells = assembled(sphere(center, radius, ratio))
    largest = largest_eigenvalue(cells.index, cells.weight, STENCIL, GRID.shape)
    # eigenvalues of elements up to 1.15, and 1 % for the iteration: 8 % of the steps
    assert fewest_steps(STENCIL, largest) <= 1.085 * fewest_steps(STENCIL, STENCIL.largest_symbol)


def test_only_cells_unlike_air_are_heterogeneous():
    for obstacles in ((), (box((2.7, 3, 3.4), (7, 7, 7.1), 1.0),)):
        _, cells = assembled(*obstacles)
        assert len(cells.index) == len(cells.rigid) == 0
    # with the sound speed of air only the surface has other stencil rows
    _, cells = assembled(box((2, 2, 2), (8, 8, 8), 77.0))
    places = np.stack(np.unravel_index(cells.index, GRID.shape), axis=-1) - GRID.first
    assert len(cells.index) == 8**3 - 4**3
    assert (np.abs(places - 4.5).max(axis=1) >= 2.5).all()


def test_no_coupling_leads_to_rigid_cells():
    _, cells = assembled(sphere((5, 5, 5), 2.6, None))
    centers = np.stack(np.meshgrid(*GRID.centers, indexing="ij"), axis=-1).reshape(-1, 3)
    depth = 2.6 - 1e3 * np.linalg.norm(centers - 5e-3, axis=1)
    assert (depth[cells.rigid] > 0).all()
    # a cell farther inside than the diagonal of an element has no air around it
    assert np.isin(np.flatnonzero(depth > math.sqrt(3)), cells.rigid).all()
    assert not np.isin(cells.index, cells.rigid).any()
    towards = cells.index[:, None] + np.array(OFFSETS) @ STRIDES
    assert not cells.weight[np.isin(towards, cells.rigid)].any()


def test_two_halves_of_a_box_are_the_box():
    """Also where they touch in a plane of cell centres."""
    _, whole = assembled(box((2, 2, 2), (8, 8, 8), 77.0))
    for joint in (5.0, 5.2, 5.5):
        _, cells = assembled(box((2, 2, 2), (joint, 8, 8), 77.0), box((joint, 2, 2), (8, 8, 8), 77.0))
        assert np.array_equal(cells.index, whole.index)
        # layers of one material in two parts: rounding of second derivatives
        assert np.allclose(cells.weight, whole.weight, rtol=0, atol=1e-9 * STENCIL.face)
        assert np.allclose(cells.mass, whole.mass, rtol=1e-9)


def test_modes_of_a_duct_of_two_fluids():
    """Between two rigid walls, part air, part heavy fluid, along the grid: its resonances are known.

    With one speed, lengths a and b and impedances z1 and z2: z2 tan(k a) + z1 tan(k b) = 0. At normal
    incidence a step of density half-way between two cells is exact, apart from the mass transferred to the
    heavy cells behind it: 0.1 % of the wavenumber at 20 cells per wavelength, 1.2 % at 7.
    """
    far = 2000
    ends = ((-far,) * 3, (1, far, far)), ((9, -far, -far), (far,) * 3)
    _, cells = assembled(*(box(*end, None) for end in ends), box((4, -far, -far), (9, far, far), 50.0))
    duct = (GRID.first + np.array([(x, 5, 5) for x in range(1, 9)])) @ STRIDES
    line = np.tile(STENCIL.weights, (len(duct), 1))
    listed = np.isin(duct, cells.index)
    line[listed] = cells.weight[np.searchsorted(cells.index, duct[listed])]
    back, _, forth = line.reshape(-1, 3, 9).sum(axis=2).T
    matrix = np.diag(back + forth) - np.diag(forth[:-1], 1) - np.diag(back[1:], -1)
    symbols = np.sort(np.linalg.eigvals(matrix).real)
    # at normal incidence the symbol is 2 - 2 cos k, as on a line
    discrete = np.arccos(1 - symbols[1:5] / 2)
    error = discrete / _duct_modes(3, 5, 1.0, 50.0)[:4] - 1
    assert abs(error[0]) < 1.5e-3
    assert np.abs(error[:3]).max() < 1.5e-2


def _duct_modes(a, b, z1, z2):
    """Wavenumbers of z2 tan(k a) + z1 tan(k b) = 0, multiplied out so that nothing is singular."""
    k = np.linspace(1e-6, 2.5, 500001)
    value = z2 * np.sin(k * a) * np.cos(k * b) + z1 * np.sin(k * b) * np.cos(k * a)
    crossing = np.flatnonzero(np.diff(np.sign(value)))
    return k[crossing] - value[crossing] * (k[1] - k[0]) / (value[crossing + 1] - value[crossing])


@settings(max_examples=40)
@given(st.lists(st.floats(-6, 0), min_size=28, max_size=28), st.integers(1, 254))
def test_condensation_keeps_the_energy_positive(exponents, gone):
    """Coupling of all sizes, as where three materials meet."""
    coupling = 10.0 ** np.array(exponents)[None]
    interface = InterfaceElements(
        coupling, np.full((1, 8), 0.1), np.zeros((1, 8), np.int64), *np.zeros((2, 1), bool), np.zeros((1, 0))
    )
    out = np.array([gone >> vertex & 1 for vertex in range(8)], bool)
    matrix = stiffness_matrix(condensed(interface, out[None]).coupling)[0]
    # rounding of the elimination
    assert np.linalg.eigvalsh(matrix).min() > -1e-9 * coupling.max()
    assert not matrix[out].any()


RATIOS = st.floats(-1.5, 5).map(lambda exponent: 10**exponent)
PLACES = st.floats(0.0, 1.0)
COARSE = tuned_stencil(0.7)
RIGID = 1e5


def flow_density(density, kappa, slowness):
    """Return the density with which waves keep their flow at a face to air."""
    inner = kappa * slowness
    return density * (math.sin(inner) / inner) / (math.sin(kappa) / kappa)


def wave(wavenumber, place):
    return cmath.exp(1j * wavenumber * place)


def response(layers, kappa):
    """Return reflection and transmission of a chain of cells with layers between two of them.

    A layer is a width, density and slowness; the first and the last have those of the half-spaces.
    """
    width = np.array([[each[0] for each in layers]])
    density = np.array([[flow_density(each[1], kappa, each[2]) for each in layers]])
    wavenumber = kappa * np.array([[each[2] for each in layers]])
    port = two_port(width, density, wavenumber, kappa)
    ends = np.array([wavenumber[0, 0], wavenumber[0, -1]])
    mass = (port.thickness[0] + 0.5) * 4 * np.sin(ends / 2) ** 2 / density[0, [0, -1]]
    matrix, right = np.zeros((2, 2), complex), np.zeros(2, complex)
    first, last = density[0, 0], density[0, -1]
    for sign, column in ((1, right), (-1, matrix[:, 0])):  # the first plane is at 0
        here, before = wave(sign * ends[0], 0), wave(sign * ends[0], -1)
        column[:] = (before - here) / first - port.link[0] * here + mass[0] * here, port.link[0] * here
    here, after = wave(ends[1], 0), wave(ends[1], 1)
    matrix[:, 1] = port.link[0] * here, (after - here) / last - port.link[0] * here + mass[1] * here
    reflected, passed = np.linalg.solve(matrix, -right)
    return complex(reflected), complex(passed)


def exact_response(layers, kappa):
    """Return the exact ones, with phases as seen from both planes, by transfer matrices."""
    whole = np.eye(2)
    for width, density, slowness in layers:
        turn, impedance = kappa * slowness * width, density / slowness
        part = [[np.cos(turn), impedance * np.sin(turn)], [-np.sin(turn) / impedance, np.cos(turn)]]
        whole = np.array(part) @ whole
    before, behind = (density / slowness for _, density, slowness in (layers[0], layers[-1]))
    # pressure and flow at the first plane are (1 + r, i (1 - r) / z), at the second (t, i t / z)
    system = np.array([[whole[0] @ (1, -1j / before), -1], [whole[1] @ (1, -1j / before), -1j / behind]])
    right = np.array([whole[0] @ (1, 1j / before), whole[1] @ (1, 1j / before)])
    reflected, passed = np.linalg.solve(system, -right)
    return complex(reflected), complex(passed)


@settings(max_examples=100)
@given(RATIOS, st.floats(0.3, 1.5), PLACES)
def test_a_wave_is_reflected_exactly_wherever_the_face_falls(density, slowness, place):
    """The error is of fourth order; its largest coefficient in 18,000 random cases was 0.11."""
    for kappa in (0.1, 0.3, 0.7):
        layers = [(place, 1.0, 1.0), (1 - place, density, slowness)]
        simulated, exact = response(layers, kappa)[0], exact_response(layers, kappa)[0]
        assert abs(simulated - exact) < 0.4 * kappa**4


@settings(max_examples=100)
@given(RATIOS, st.floats(0.3, 1.5), st.floats(0.001, 0.9), PLACES)
def test_a_layer_thinner_than_a_cell_reflects_and_transmits_exactly(density, slowness, width, share):
    """The layer may be anywhere between two planes of cells, and thin; the largest coefficient was 0.32."""
    place = share * (1 - width)
    layers = [(place, 1.0, 1.0), (width, density, slowness), (1 - width - place, 1.0, 1.0)]
    for kappa in (0.1, 0.3, 0.7):
        for simulated, exact in zip(response(layers, kappa), exact_response(layers, kappa), strict=True):
            assert abs(simulated - exact) < kappa**4 / min(1, density)


@given(PLACES, st.floats(0.01, 0.95), st.floats(20.0, 1e4), st.floats(0.1, 0.9))
def test_sound_goes_along_a_gap_between_heavy_layers_as_through_its_width(share, width, density, kappa):
    """No plane of cells is in the gap. Both have its volume and its mobility; the rest is the walls' part."""
    place = share * (1 - width)
    layers = np.array([[place, width, 1 - width - place]]), np.array([[density, 1.0, density]])
    port = two_port(*layers, np.full((1, 3), kappa), kappa)
    volume, mobility = port.thickness.sum() / density, port.mobility.sum() / 2
    assert (volume, mobility) == pytest.approx((width, width), abs=1.01 / density)


@given(st.floats(1.0, 6.9), st.floats(0.06, 1.5), PLACES)
def test_a_gap_without_a_plane_of_cells_is_one_whatever_planes_others_have_in_it(begin, width, share):
    end = begin + width
    assume(min(abs(place - round(place)) for place in (begin, end)) > 1e-4)  # planes move off vertices
    walls = MaterialBlocks.between(
        [np.array([begin, begin + share * width, end]), np.zeros(0), np.zeros(0)],
        (9, 2, 2),
        lambda cells: ((cells[..., 0] < begin) | (cells[..., 0] > end)).astype(np.int64),
    )
    beside = walls.beside_gaps(np.array([False, True]))
    assert beside.tolist() == ([1] if math.floor(begin) == math.floor(end) else [])


def corner(place):
    """Return an element with material 1 in the quarter before the faces at `place`."""
    return Section(((place[0],), (place[1],)), ((1, 0), (0, 0)))


def end_of_plate(end, low, thickness):
    """Return the element at the end of a plate of material 1 along the first axis."""
    return Section(((end,), (low, low + thickness)), ((0, 1, 0), (0, 0, 0)))


def materials(density):
    return MaterialKey((1.0, density), (1.0, 1 / density), (False, density >= RIGID))


@pytest.mark.parametrize("place", [(0.5, 0.5), (0.2, 0.7), (0.05, 0.9)])
def test_fields_at_a_rigid_edge_grow_with_powers_of_two_thirds(place):
    fields = plane_fields(corner(place), np.array((1.0, 0.0)), 4)
    # the powers are exact for a circle; the window is a square
    assert fields.order[1:] == pytest.approx(np.arange(1, 5) * 2 / 3, rel=0.02)
    # its exact field passes the elements beside the edge: r^(2/3) cos(2/3 phi)
    places = np.stack(np.meshgrid(np.arange(-1, 3), np.arange(-1, 3), indexing="ij"), axis=-1) - place
    radius, angle = np.hypot(*places.T).T, np.arctan2(places[..., 1], places[..., 0]) + np.pi / 2
    near = fields.values[2:6, 2:6][fields.present[2:6, 2:6]]
    powers = 2 / 3 * np.arange(9)
    exact = (radius[..., None] ** powers * np.cos(angle[..., None] * powers))[fields.present[2:6, 2:6]]
    fit = exact @ np.linalg.lstsq(exact, near, rcond=None)[0]
    assert np.abs(fit - near).max() < 2e-3  # the mesh ends at 0.005 cells


@pytest.mark.parametrize("thickness", [0.01, 0.1])
def test_fields_at_a_thin_plate_grow_with_powers_of_a_half(thickness):
    fields = plane_fields(end_of_plate(0.4, 0.3, thickness), np.array((1.0, 0.0)), 4)
    # the rim is shorter by the thickness
    assert fields.order[1:] == pytest.approx(np.arange(1, 5) / 2, rel=0.02)


def whole_element(elements):
    """Return the stiffness matrix (8, 8) of the element of a section."""
    coupling, _ = stacked(np.ones((1, 1)), Prisms(*(part[None, None] for part in elements)), 2, COARSE)
    return stiffness_matrix(coupling)[0]


@pytest.mark.parametrize(
    "section", [corner((0.2, 0.7)), corner((0.5, 0.5)), corner((1e-5, 0.05)), end_of_plate(0.4, 0.3, 0.02)]
)
@given(RATIOS)
@settings(max_examples=10)
def test_elements_at_an_edge_have_a_positive_energy_and_the_mass_of_their_volume(section, density):
    elements = prisms(section, materials(density), COARSE)
    matrix = whole_element(elements)
    assert np.linalg.eigvalsh(matrix).min() > -1e-9 * np.abs(matrix).max()  # rounding
    x, y = (np.diff(np.concatenate(([0.0], cuts, [1.0]))) for cuts in section.cuts)
    masses = np.array(materials(density).masses)[np.array(section.material)]
    # the sum of the masses weighs a hundred times as much as their moments
    assert elements.mass.sum() == pytest.approx(x @ masses @ y, rel=1e-3)


@pytest.mark.parametrize("density", [RIGID, 77.0, 0.1])
def test_images_of_an_edge_have_images_of_its_elements(density):
    here = prisms(corner((0.2, 0.7)), materials(density), COARSE)
    exchanged = prisms(corner((0.7, 0.2)), materials(density), COARSE)
    matrix, image = (stiffness_matrix(each.coupling, COLUMN_PAIRS) for each in (here, exchanged))
    columns = [0, 2, 1, 3]  # (0, 1) and (1, 0) change places
    assert matrix == pytest.approx(image[np.ix_(columns, columns)], rel=1e-12)  # sums of a row by order
    mirrored = Section(((0.8,), (0.7,)), ((0, 0), (1, 0)))
    assert np.array_equal(here.mass, prisms(mirrored, materials(density), COARSE).mass[::-1])


def test_an_edge_of_air_in_air_is_none():
    """The fit ends where it starts: the stencil's coupling reproduces long waves."""
    elements = prisms(corner((0.3, 0.8)), materials(1.0), COARSE)
    # fields at the rim of the mesh are no polynomials: 1.3e-3 measured
    assert whole_element(elements) == pytest.approx(
        stiffness_matrix(uniform_coupling(COARSE)[None])[0], abs=2e-2
    )
