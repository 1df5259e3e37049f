"""Bodies that absorb: exact solutions, passive and stable forms, the power they take, gradients."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from bloch_chain import reflection
from hypothesis import example, given
from hypothesis import strategies as st
from lossy_bodies import AIR, FREQUENCY, WAVENUMBER, BoxRun, incident, region_of_bodies, sphere, sphere_series
from scipy.sparse import coo_array
from small_scenes import relative_error, small_scene

from autdtorch.analytic import fluid_slab
from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import heterogeneous_cells
from autdtorch.fdtd.assembly.losses import positive_part
from autdtorch.fdtd.grid import make_box, make_grid
from autdtorch.fdtd.region import MIN_CELLS_PER_WAVELENGTH, Body, Fluid
from autdtorch.fdtd.stencil import OFFSETS, flat_offsets
from autdtorch.fdtd.stepping import air_stencil, assemble_on
from autdtorch.propagators import make_propagator
from autdtorch.propagators.absorbed_power import absorption
from autdtorch.propagators.plan import region_of
from autdtorch.scene.arrays import strengths_of
from autdtorch.scene.obstacles import Box, Cylinder, Sphere

CENTER = np.array([0.13e-3, 0.21e-3, -0.32e-3])
"""Centre of bodies between the cells [m]."""

FOAM = Fluid(1.2 * (2 + 0.5j), 240 * (1 - 0.2j))
CLOTH = Fluid(1.2 * (1.5 + 1j), 340 / (1.5 + 1j) ** 0.5)
"""Absorbs by its density alone."""

RUBBER = Fluid(3.0, 300 * (1 - 0.05j))


def ball(radius, **material):
    """A sphere; without material it is rigid."""
    fluid, impedance = material.get("fluid"), material.get("impedance")
    return Body(Sphere(tuple(CENTER), radius, rigid=True), fluid, impedance=impedance)


# twice the errors at 1 mm; rigid and loss-free spheres of 8 mm have 0.3 and 0.2 %
@pytest.mark.parametrize(
    ("material", "tolerance"),
    [
        pytest.param({"fluid": FOAM}, 0.003, id="foam"),
        pytest.param({"impedance": 3 - 3j}, 0.004, id="mass"),
        pytest.param({"impedance": 3 + 3j}, 0.006, id="spring"),
    ],
)
def test_spheres_are_their_series_and_take_the_power_that_flows_in(material, tolerance):
    region = region_of_bodies(ball(8e-3, **material))
    run = BoxRun(region, 1e-3, lambda assembly: absorption(assembly, region).cells)
    points = sphere(0.03)
    exact = sphere_series(8e-3, CENTER, points, **material)
    total = incident(points) + exact
    assert np.linalg.norm(run.scattered(points) - exact) <= tolerance * np.linalg.norm(total)

    absorbed = absorption(run.assembly, region)
    place = torch.from_numpy(np.searchsorted(run.cells, absorbed.cells))
    driven = run.box.positions(absorbed.cells).numpy()
    field = run.phasors[place] + torch.from_numpy(incident(driven))
    power = absorbed.power(field[:, None], 1).item()
    # the figure
    assert power == pytest.approx(inflow(lambda at: incident(at) + run.scattered(at)), rel=0.01)


def inflow(field, radius=0.02, count=1000, step=1e-6):
    """Return the power [W] that flows into a sphere."""
    inner, outer = (field(sphere(size, count)) for size in (radius - step, radius + step))
    velocity = (outer - inner) / (2 * step) / (2j * math.pi * FREQUENCY * AIR.density)
    flow = ((outer + inner) / 2 * velocity.conj()).real.mean() / 2
    return -flow * 4 * math.pi * radius**2


def forms(assembly):
    """Return the matrices M + D, M - D - C and K of the scheme, on the heterogeneous cells and their rim."""
    c, grid = assembly.coefficients, assembly.grid
    around = np.unique(c.heterogeneous_index.numpy()[:, None] + flat_offsets(grid.shape))
    inside = grid.inside(around) & ~np.isin(around, c.sound_hard_index.numpy())
    rows = around[inside]
    mass = assembly.heterogeneous.mass_of(rows)
    air = np.array((0, c.face, c.edge, c.corner))[np.abs(OFFSETS).sum(axis=1)]
    weight, loss = np.tile(air, (len(rows), 1)), np.zeros((len(rows), 27))
    weight[np.searchsorted(rows, c.heterogeneous_index.numpy())] = c.heterogeneous_weight.numpy()
    lossy = np.searchsorted(rows, c.loss_index.numpy())
    loss[lossy] = c.loss_weight.numpy()
    weight[:, 13] -= weight.sum(axis=1)
    weight[lossy, 13] -= c.loss_ground.numpy()
    place = np.full(math.prod(grid.shape), -1)
    place[rows] = np.arange(len(rows))
    column = place[rows[:, None] + flat_offsets(grid.shape)]
    row = np.broadcast_to(np.arange(len(rows))[:, None], column.shape)
    known = column >= 0  # cells around are held at zero

    def matrix(values):
        size = (len(rows), len(rows))
        return coo_array(((mass[:, None] * values)[known], (row[known], column[known])), size).toarray()

    whole = np.diag(mass)
    return whole, c.keep * whole + matrix(loss), -matrix(weight)


@given(st.integers(0, 2**32 - 1), st.floats(-1, 1), st.floats(0, 8))
def test_losses_without_their_negative_part_are_as_small_as_they_were(seed, share, digits):
    """Also where a constant pressure loses next to no power: nothing may be divided by that.

    Four fields keep their flow, each no larger than the form; the rest is at most five times as large.
    """
    spread = np.random.default_rng(seed).standard_normal((8, 8))
    form = spread + share * spread.T
    form = (form + form.T)[None]
    constant = np.full(8, 8**-0.5)
    power = constant @ form[0] @ constant
    form += (10**-digits - power) * np.outer(constant, constant)
    positive = positive_part(form)
    size = np.linalg.norm(form)
    assert np.linalg.eigvalsh(positive).min() > -1e-12 * size
    assert np.linalg.norm(positive) < 9 * size
    passive = spread @ spread.T
    np.testing.assert_allclose(positive_part(passive[None])[0], passive, atol=1e-12 * np.linalg.norm(passive))


@given(
    st.sampled_from([Sphere, Box]),
    st.floats(0.3, 3.0),
    st.floats(0.42, 1.5),
    st.floats(0, 1.2),
    st.floats(0, 0.6),
    st.sampled_from([None, None, 1.0, 0.2 - 0.3j, 5 + 20j, 1e-3]),
    st.sampled_from([(0.4, 0.3, 0.2), (0.0, 0.0, 0.0)]),
)
@example(Box, 0.35, 0.42, 1.016, 0.0, None, (0.0, 0.0, 0.0))  # cells of 1.1 mm are refused
def test_bodies_are_passive_and_stable(kind, density, speed, angle, loss, impedance, rotation):
    size = 1.7e-3 if kind is Sphere else (3.6e-3, 2.2e-3, 3e-3)
    turn = {} if kind is Sphere else {"rotation": rotation}
    shape = kind(tuple(CENTER), size, rigid=True, **turn)
    rho, compressibility = (
        1.2 * density * (1 + 1j * angle),
        (1 + 1j * loss) / density / (340 * speed) ** 2 / 1.2,
    )
    fluid = None if impedance else Fluid(rho, (1 / rho / compressibility) ** 0.5)
    region = region_of_bodies(Body(shape, fluid, impedance=impedance))
    coarsest = region.shortest_wavelength / MIN_CELLS_PER_WAVELENGTH  # short where slow bodies lose
    require_passive_and_stable(region, make_box(region, min(1.1e-3, coarsest)))


def require_passive_and_stable(region, grid):
    """Losses D + C / 2 and stiffness K are forms that are not negative; leapfrog is stable with both."""
    whole, late, stiffness = forms(assemble_on(grid, region, torch.float64, None))
    size = 1e-9 * np.abs(stiffness).max()  # rounding; rows within 1e-9 of air's are air's
    for matrix in (late, stiffness):
        assert np.abs(matrix - matrix.T).max() <= size
    assert np.linalg.eigvalsh(whole - late)[0] >= -size
    assert np.linalg.eigvalsh(stiffness)[0] >= -size
    assert np.linalg.eigvalsh(2 * (whole + late) - stiffness)[0] >= -size


def chain(body, thickness):
    """Return reflection and transmission of a plate, exact on the grid except in the cells of its faces.

    Along the middle of a plate that crosses the domain the cells are a chain, solved here at the drive's
    frequency.
    """
    region = region_of_bodies(body)
    lower, upper = region.domain
    region = replace(region, domain=((-4e-3, -4e-3, lower[2]), (4e-3, 4e-3, upper[2])))
    grid = make_grid(region, 1e-3)
    stencil = air_stencil(grid, region)
    cells = heterogeneous_cells(elements_of(region, grid, stencil), stencil)
    x, y, z = grid.shape
    line = (x // 2 * y + y // 2) * z + np.arange(z)
    place = np.searchsorted(cells.index, line).clip(max=len(cells.index) - 1)
    varies = cells.index[place] == line
    coupling = np.tile(stencil.weights.astype(complex), (z, 1))
    mass = np.ones(z, complex)
    losses = cells.loss_rows[place[varies]]
    coupling[varies] = (cells.weight * cells.mass[:, None])[place[varies]] - 1j * losses[:, :27]
    mass[varies] = cells.mass[place[varies]] + 1j * losses[:, 27] / stencil.symbol
    ahead = [np.array(OFFSETS)[:, 2] == step for step in (-1, 1)]
    below, above = (coupling[:, each].sum(axis=1) for each in ahead)
    # incident e^{ikz} from below: the ends radiate outwards
    middle = slice(20, z - 20)
    number = np.arange(z)[middle]
    size, wave = len(number), np.exp(1j * stencil.kappa)
    matrix = np.diag(stencil.symbol * mass[middle] - below[middle] - above[middle])
    matrix += np.diag(above[middle][:-1], 1) + np.diag(below[middle][1:], -1)
    matrix[0, 0] += wave
    matrix[-1, -1] += wave
    stiff = np.zeros(z)
    stiff[varies] = losses[:, 28]
    matrix -= np.diag(stiff[middle])
    hard = np.isin(line[middle], cells.rigid)
    matrix[hard], matrix[:, hard] = 0, 0
    matrix[hard, hard] = 1
    source = np.zeros(size, complex)
    source[0] = -(1 / wave - wave)  # of the incident wave 1 in the first cell
    pressure = np.linalg.solve(matrix, source)
    reflected, transmitted = pressure[0] - 1, pressure[-1] * wave ** -(size - 1)
    face = (grid.origin[2] + grid.spacing * number[0] + thickness / 2) * WAVENUMBER  # phase to the first face
    reflected *= np.exp(2j * face)
    transmitted *= np.exp(1j * WAVENUMBER * thickness)
    return reflected, transmitted


def plate(thickness):
    return Box((0.0, 0.2e-3, 0.0), (0.2, 0.2, thickness), rigid=True)


# the figure at 1 mm; in foam a wavelength is 6 cells, where plates without loss have up to 0.007
@pytest.mark.parametrize(
    ("fluid", "tolerance"), [(FOAM, 0.007), (CLOTH, 0.005), (RUBBER, 0.005)], ids=["foam", "cloth", "rubber"]
)
@pytest.mark.parametrize("thickness", [0.4e-3, 3.3e-3, 11.7e-3])
def test_slabs_reflect_and_transmit_as_they_should(fluid, tolerance, thickness):
    reflected, transmitted = chain(Body(plate(thickness), fluid), thickness)
    ratio = fluid.density * fluid.sound_speed / AIR.density / AIR.sound_speed
    inner = WAVENUMBER * AIR.sound_speed / fluid.sound_speed * thickness
    below_slab = 2 * ratio * np.cos(inner) - 1j * (ratio**2 + 1) * np.sin(inner)
    expected = -1j * (ratio**2 - 1) * np.sin(inner) / below_slab, 2 * ratio / below_slab
    assert abs(reflected - expected[0]) <= tolerance
    assert abs(transmitted - expected[1]) <= tolerance


@pytest.mark.parametrize("impedance", [1.0, 0.3, 2 + 2j, 0.5 - 1j])
@pytest.mark.parametrize("thickness", [0.9e-3, 3.3e-3])
def test_walls_with_an_impedance_reflect_as_they_should(impedance, thickness):
    """Along the grid they are exact at normal incidence, up to terms of third order in the wavenumber."""
    reflected, transmitted = chain(Body(plate(thickness), None, impedance=impedance), thickness)
    assert abs(reflected - (impedance - 1) / (impedance + 1)) < 1e-3
    assert abs(transmitted) < 1e-6


# The reaction of the air before the face is exact at the normal alone. At 40 degrees it errs by 0.002 at a
# depth of 0.35 cells and by 0.003 at 0.65, in third order of the wavenumber: the tolerances are twice that.
# With the nearest cell alone, 0.65 cells away, the error would be 0.05.
@pytest.mark.parametrize("impedance", [3.0, 3 - 1j])
@pytest.mark.parametrize(("depth", "tolerance"), [(0.35, 0.004), (0.65, 0.006)])
def test_walls_with_an_impedance_reflect_obliquely_wherever_they_are(impedance, depth, tolerance):
    angle = math.radians(40)
    expected = (impedance * math.cos(angle) - 1) / (impedance * math.cos(angle) + 1)
    reflected = reflection((0, 0, 1), -depth, 1e-3, angle, 0.3, impedance=impedance)
    assert abs(reflected - expected) < tolerance


# Errors of third order remain, 0.004 and less: the tolerance is twice that. Without slopes along the surface
# the error at the normal would be 0.026.
@pytest.mark.parametrize("impedance", [1.0, 3 - 1j])
@pytest.mark.parametrize("incidence", [0, 60])
@pytest.mark.parametrize(("normal", "offset"), [((1, 1, 0), 0.1), ((1, 1, 0), 0.45), ((2, 1, 0), 0.3)])
def test_tilted_walls_with_an_impedance_reflect_as_they_should(impedance, incidence, normal, offset):
    angle = math.radians(incidence)
    expected = (impedance * math.cos(angle) - 1) / (impedance * math.cos(angle) + 1)
    reflected = reflection(normal, offset, 0.7e-3, angle, 0.3, impedance=impedance)
    assert abs(reflected - expected) < 0.008


# stiff, massive and resonant with the air before the face, whose mass and stiffness add to those of two cells
@pytest.mark.parametrize(
    ("impedance", "place"),
    [
        (1.0, 0.1), (0.1, 0.5), (1e-3, 0.9), (0.3j, 0.1),
        (0.05 + 0.4j, 0.5), (0.7j, 0.9), (-0.3j, 0.1), (0.01 - 1j, 0.5),
    ],
)  # fmt: skip
def test_faces_along_the_grid_are_passive_and_stable(impedance, place):
    shape = Box((place * 1e-3,) * 3, (2.4e-3, 1.9e-3, 2.1e-3), rigid=True)
    region = region_of_bodies(Body(shape, None, impedance=impedance))
    require_passive_and_stable(region, make_box(region, 1.1e-3))


def surface_of_box(x, y, z):
    return 2 * (x * y + y * z + z * x)


# The sum of the damping is off by the square of the phase between two cells at 4 kHz, 5e-4 and less; along
# the grid areas are exact. Elsewhere distances are linear in quarters of a cell: edges are rounded by a few
# hundredths of a cell, 0.4 % of these bodies, and 1.6 % of the plate, whose rim is two edges.
@pytest.mark.parametrize("spacing", [0.93e-3, 1.6e-3])
@pytest.mark.parametrize(
    ("shape", "area", "tolerance"),
    [
        (Box(tuple(CENTER), (9e-3, 7e-3, 8e-3), rigid=True), surface_of_box(9, 7, 8), 2e-3),
        (Box(tuple(CENTER), (9e-3, 0.7e-3, 8e-3), rigid=True), surface_of_box(9, 0.7, 8), 2e-3),
        (Box(tuple(CENTER), (9e-3, 7e-3, 8e-3), (0.5, 0.3, 0.2), rigid=True), surface_of_box(9, 7, 8), 0.01),
        (
            Box(tuple(CENTER), (9e-3, 0.7e-3, 8e-3), (0.5, 0.3, 0.2), rigid=True),
            surface_of_box(9, 0.7, 8),
            0.03,
        ),
        (Sphere(tuple(CENTER), 4e-3, rigid=True), 4 * math.pi * 4**2, 4e-3),
        (Cylinder(tuple(CENTER), 4e-3, 6e-3, (0.5, 0.3, 0.2), rigid=True), 2 * math.pi * 4 * (4 + 6), 0.01),
        # slender: a staircase, of more area than theirs along the axis and of as much at the ends
        (Cylinder(tuple(CENTER), 0.5e-3, 15e-3, (0, 0, 1), rigid=True), 2 * math.pi * 0.5 * (0.5 + 15), 2e-3),
        (Cylinder(tuple(CENTER), 1e-3, 2e-3, (0, 0, 1), rigid=True), 2 * math.pi * 1 * (1 + 2), 2e-3),
    ],
    ids=["box", "plate", "turned box", "turned plate", "sphere", "cylinder", "wire", "stub"],
)
def test_areas_of_surfaces_are_true(shape, area, tolerance, spacing):
    """All vertices together share the area of surfaces, where waves are long, wherever these fall."""
    region = replace(region_of_bodies(Body(shape, None, impedance=1.0)), frequency=4e3)
    grid = make_box(region, spacing)
    stencil = air_stencil(grid, region)
    cells = heterogeneous_cells(elements_of(region, grid, stencil), stencil)
    total = cells.loss_rows[:, 27].sum() / (stencil.slope.real / 2) * (1e3 * spacing) ** 2
    assert total == pytest.approx(area, rel=tolerance)


def test_a_lossy_plate_continues_through_the_absorbing_layers():
    """The field behind it equals an infinite slab's."""
    plate = Box((14e-3, 12e-3, 12e-3), (3e-3, 90e-3, 90e-3), density=3.0, sound_speed=300.0, absorption=300.0)
    scene = small_scene((plate,))
    fluid = region_of(scene).bodies[0].fluid
    ratios = fluid.density / scene.medium.density, fluid.sound_speed / scene.medium.sound_speed
    exact = fluid_slab(
        scene.control_points,
        scene.array.positions,
        scene.wavenumber,
        (12.5e-3, 0, 0),
        (-1, 0, 0),
        3e-3,
        *ratios,
    )
    exact = 4 * math.pi * exact * strengths_of(scene.array)
    # five times what is found
    assert relative_error(make_propagator(scene, "full", spacing=1e-3).transfer_matrix(), exact) < 2.5e-3


@pytest.mark.parametrize(
    ("material", "what"),
    [
        ({"fluid": FOAM}, "a fluid of complex density"),
        ({"fluid": None, "impedance": 2 + 1j}, "a surface with"),
    ],
)
def test_what_would_grow_in_the_layers_ends_inside_the_domain(material, what):
    wall = Body(Box((0, 0, 0), (1.0, 1.0, 4e-3), rigid=True), continued=True, **material)
    region = region_of_bodies(wall)
    grid = make_grid(region, 2e-3)
    with pytest.raises(ValueError, match=rf"obstacles\[0\]: {what} .* end inside"):
        elements_of(region, grid, air_stencil(grid, region))
