"""Elements at faces and edges parallel to the grid, against exact waves and singular fields."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.fdtd.assembly.element import stiffness_matrix, uniform_coupling
from autdtorch.fdtd.assembly.layers import two_port
from autdtorch.fdtd.assembly.prisms import Prisms, prisms, stacked
from autdtorch.fdtd.assembly.sections import MaterialKey, Section, plane_fields
from autdtorch.fdtd.stencil import tuned_stencil

RATIOS = st.floats(-1.5, 5).map(lambda exponent: 10**exponent)
PLACES = st.floats(0.0, 1.0)
STENCIL = tuned_stencil(0.7)
RIGID = 1e5


def assembled(density, kappa, slowness):
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
    density = np.array([[assembled(each[1], kappa, each[2]) for each in layers]])
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


def corner(place):
    """Return an element with material 1 in the quarter before the faces at `place`."""
    return Section((1, 1), ((place[0],), (place[1],)), ((1, 0), (0, 0)))


def end_of_plate(end, low, thickness):
    """Return the elements at the end of a plate of material 1 along the first axis."""
    return Section((1, math.ceil(low + thickness)), ((end,), (low, low + thickness)), ((0, 1, 0), (0, 0, 0)))


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
    """Return the stiffness matrix (8, 8) of the first element of a section."""
    coupling, _ = stacked(np.ones(1), [Prisms(*(part[0, 0] for part in elements))], 2, STENCIL)
    return stiffness_matrix(coupling[None])[0]


@pytest.mark.parametrize(
    "section", [corner((0.2, 0.7)), corner((0.5, 0.5)), corner((1e-5, 0.05)), end_of_plate(0.4, 0.3, 0.02)]
)
@given(RATIOS)
@settings(max_examples=10)
def test_elements_at_an_edge_have_a_positive_energy_and_the_mass_of_their_volume(section, density):
    elements = prisms(section, materials(density), STENCIL)
    matrix = whole_element(elements)
    assert np.linalg.eigvalsh(matrix).min() > -1e-9 * np.abs(matrix).max()  # rounding
    x, y = (np.diff(np.concatenate(([0.0], cuts, [1.0]))) for cuts in section.cuts)
    masses = np.array(materials(density).masses)[np.array(section.material)]
    # the sum of the masses weighs a hundred times as much as their moments
    assert elements.mass[0, 0].sum() == pytest.approx(x @ masses @ y, rel=1e-3)


@pytest.mark.parametrize("density", [RIGID, 77.0, 0.1])
def test_images_of_an_edge_have_images_of_its_elements(density):
    here = prisms(corner((0.2, 0.7)), materials(density), STENCIL)
    exchanged = prisms(corner((0.7, 0.2)), materials(density), STENCIL)
    assert np.array_equal(here.coupling[0, 0], exchanged.coupling[0, 0].transpose(1, 0, 3, 2))
    mirrored = Section((1, 1), ((0.8,), (0.7,)), ((0, 0), (1, 0)))
    assert np.array_equal(here.mass[0, 0], prisms(mirrored, materials(density), STENCIL).mass[0, 0, ::-1])


def test_an_edge_of_air_in_air_is_none():
    """The fit ends where it starts: the stencil's coupling reproduces long waves."""
    elements = prisms(corner((0.3, 0.8)), materials(1.0), STENCIL)
    # fields at the rim of the mesh are no polynomials: 1.3e-3 measured
    assert whole_element(elements) == pytest.approx(
        stiffness_matrix(uniform_coupling(STENCIL)[None])[0], abs=2e-2
    )
