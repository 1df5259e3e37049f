"""`differentiable_field` against differences and the propagator; a pose fitted by its gradients."""

import re
import warnings

import numpy as np
import pytest
import torch
from small_scenes import AIR, relative_error, small_scene

import autdtorch as at
from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import heterogeneous_cells
from autdtorch.fdtd.grid import make_grid
from autdtorch.fdtd.material_gradients import cells_of_maps
from autdtorch.fdtd.stepping import air_stencil
from autdtorch.propagators.plan import region_of

SPHERE = at.Sphere((6.2e-3, 5.7e-3, 6.1e-3), 2e-3, density=20.0, sound_speed=300.0)
RIGID = at.Sphere((3e-3, 9.5e-3, 9.5e-3), 1.7e-3, rigid=True)
BOX = at.Box((9e-3, 9e-3, 3e-3), (3e-3, 3e-3, 3e-3), density=3.0, sound_speed=400.0)
WALL = at.Box((6e-3, 6e-3, 12e-3), (40e-3, 40e-3, 2e-3), density=5.0, sound_speed=340.0)

DRIVE = torch.tensor([0.9, 0.9j, -0.4, 0.3 - 0.7j], dtype=torch.complex128)
EXACT = {"spacing": 2e-3, "periods": 3, "kernel": "cpu", "dtype": "float64"}
LONGER = EXACT | {"periods": 9}
short_run = pytest.mark.filterwarnings("ignore::autdtorch.SteadyStateWarning")


def materials(*obstacles):
    values = [[getattr(one, name) or 1.0 for one in obstacles] for name in ("density", "sound_speed")]
    return [torch.tensor(each, dtype=torch.float64, requires_grad=True) for each in values]


def maps(scene, spacing, seed=0):
    """Random density of 1 to 5 times air's and sound speed of 0.9 to 1.3 times air's."""
    shape = at.cell_centers(scene, spacing).shape[:3]
    generator = torch.Generator().manual_seed(seed)
    density, speed = (torch.rand(shape, generator=generator, dtype=torch.float64) for _ in range(2))
    density, speed = AIR.density * (1 + 4 * density), AIR.sound_speed * (0.9 + 0.4 * speed)
    return density.requires_grad_(), speed.requires_grad_()


@short_run
def test_gradcheck_of_drive_density_and_sound_speed():
    """Of maps, which include the cells of the sources; the tolerances are the defaults of gradcheck."""
    scene = small_scene(extent=12e-3)

    def field(drive, density, sound_speed):
        return at.differentiable_field(scene, drive, density=density, sound_speed=sound_speed, **EXACT)

    assert torch.autograd.gradcheck(
        field, (DRIVE.clone().requires_grad_(), *maps(scene, 2e-3)), fast_mode=True
    )


@short_run
def test_every_material_has_a_derivative():
    """Against a difference by all of them: to the 1e-8 that both have, and what rounding leaves of that."""
    scene = small_scene((SPHERE, RIGID, BOX), extent=12e-3)
    drive = DRIVE.clone().requires_grad_()
    medium = dict(zip(("density", "sound_speed"), materials(SPHERE, RIGID, BOX), strict=True))

    def loss(**values):
        return at.differentiable_field(scene, drive, **values, **EXACT).abs().sum()

    (whole := loss(**medium)).backward()
    # the field is linear in the drive
    assert (drive.grad.conj() * drive).real.sum().item() == pytest.approx(whole.item(), rel=1e-9)
    steps = {name: 1e-4 * values.detach() * values.grad.sign() for name, values in medium.items()}
    ends = [
        loss(**{name: values.detach() + way * steps[name] for name, values in medium.items()}).item()
        for way in (1, -1)
    ]
    parts = torch.stack([steps[name] * values.grad for name, values in medium.items()])
    assert parts.sum().item() == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-6)
    assert (parts[:, ::2] > 1e-3 * parts.sum()).all()  # each would be missed
    assert not parts[:, 1].any()  # the rigid one


@short_run
def test_cells_of_airs_sound_speed_have_their_mass():
    """Inside a dense body whose cells step like air, and by the densities of two that touch as one."""
    fluid = {"density": 20.0, "sound_speed": AIR.sound_speed}
    bodies = at.Box((12e-3,) * 3, (9e-3,) * 3, **fluid), at.Box((12e-3, 12e-3, 19e-3), (5e-3,) * 3, **fluid)
    scene, inside = small_scene(bodies, extent=24e-3), [(12e-3,) * 3]
    density = torch.tensor([20.0, 20.0], dtype=torch.float64, requires_grad=True)
    drive = DRIVE.clone().requires_grad_()

    def pressure(density, points=None):
        # the largest stable time step changes with the density
        field = at.differentiable_field(scene, drive, points, density=density, time_step=3e-6, **LONGER)
        return torch.view_as_real(field).sum()

    # the field is linear in the drive
    (within := pressure(None, inside)).backward()
    linear = torch.view_as_real(drive.grad.conj() * drive)[..., 0].sum()
    assert linear.item() == pytest.approx(within.item(), rel=1e-9)
    pressure(density).backward()
    parts = 0.02 * density.grad.abs()
    ends = [pressure(density.detach() + way * 0.02 * density.grad.sign()).item() for way in (1, -1)]
    # truncation is (1e-3)^2 of the slope
    assert parts.sum().item() == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-4)
    assert (parts > 0.01 * parts.sum()).all()  # each would be missed


@short_run
def test_several_drives_are_one_by_one():
    scene = small_scene((SPHERE,), extent=12e-3)
    both = torch.stack((DRIVE, DRIVE.conj())).requires_grad_()
    field = at.differentiable_field(scene, both, **EXACT)
    field.abs().sum().backward()
    for drive, slope, row in zip(both.detach(), both.grad, field, strict=True):
        single = drive.clone().requires_grad_()
        alone = at.differentiable_field(scene, single, **EXACT)
        alone.abs().sum().backward()
        # sums of both drives may be taken in another order than those of one
        torch.testing.assert_close(alone, row, rtol=0, atol=1e-12 * float(row.detach().abs().max()))
        torch.testing.assert_close(single.grad, slope, rtol=0, atol=1e-12 * float(slope.abs().max()))


def test_field_and_gradient_by_the_drive_are_those_of_the_propagator():
    """In the steady state, to the tolerance of the propagator."""
    scene = small_scene((SPHERE, RIGID), extent=16e-3)
    matrix = at.make_propagator(scene, "full", 1.5e-3, tolerance=1e-4).transfer_matrix()
    drive, exact = DRIVE.clone().requires_grad_(), DRIVE.clone().requires_grad_()
    field = at.differentiable_field(scene, drive, spacing=1.5e-3, periods=60)
    field.abs().sum().backward()
    (matrix @ exact).abs().sum().backward()
    assert relative_error(field.detach(), matrix @ DRIVE) < 1e-3
    assert relative_error(drive.grad, exact.grad) < 1e-3


def test_a_run_that_ends_before_its_steady_state_says_how_many_periods_do():
    """Two rigid plates a wavelength apart ring; the points are behind them."""
    plates = [at.Box((x, 12e-3, 12e-3), (2e-3, 14e-3, 14e-3), rigid=True) for x in (6e-3, 16.5e-3)]
    scene = small_scene(plates)
    exact = at.make_propagator(scene, "full", 1.5e-3, tolerance=1e-4).transfer_matrix() @ DRIVE

    def run(periods):
        """Return the error, the estimated one, and the periods that a warning advises."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            field = at.differentiable_field(scene, DRIVE, spacing=1.5e-3, periods=periods)
        texts = [str(each.message) for each in caught if each.category is at.SteadyStateWarning]
        found = [re.search(r"relative error up to (\S+), .* about (\d+)$", text).groups() for text in texts]
        return relative_error(field, exact), *(found[0] if found else (None, None))

    error, estimated, periods = run(None)
    # as of other runs, estimates are 0.5 to 10 times the distance; 6 times measured here
    assert 0.3 < float(estimated) / error < 15
    advised = [int(periods)]
    while periods:
        error, _, periods = run(advised[-1])
        advised += [int(periods)] if periods else []
    assert error < 2e-3
    assert len(advised) <= 3  # two measured, 36 and 64: the first comes from a run of few blocks
    assert run(1)[1] == "2.0e+00"  # sound has not arrived at the points


def test_uniform_maps_are_a_material():
    """Deep in a box a map has the rows of an obstacle, and masses in proportion; a map of air is air."""
    air = small_scene(extent=24e-3)
    box = at.Box((12e-3, 12e-3, 12e-3), (12e-3, 12e-3, 12e-3), density=3.0, sound_speed=450.0)
    scene = small_scene((box,), extent=24e-3, absorption=40.0)
    grid = make_grid(region_of(scene), 2e-3)
    stencil = air_stencil(grid, region_of(scene))
    cells = heterogeneous_cells(elements_of(region_of(scene), grid, stencil), stencil)
    shape = at.cell_centers(air, 2e-3).shape[:3]
    full = torch.ones(shape, dtype=torch.float64)
    same = cells_of_maps(region_of(scene), grid, 3.0 * full, 450.0 * full).heterogeneous
    places = np.stack(np.unravel_index(cells.index, grid.shape), axis=-1)
    far = box.signed_distance(np.array(grid.origin) + grid.spacing * places).numpy()
    deep = far < -1.8 * grid.spacing
    assert deep.sum() >= 8
    place = np.searchsorted(same.index, cells.index[deep])
    # the mean over directions is a quadrature in the one and a closed form in the other
    np.testing.assert_allclose(same.weight[place], cells.weight[deep], rtol=1e-9, atol=1e-12)
    # a map keeps the impedance at faces half-way between cells, an obstacle the flow at any
    ratio = same.mass[place] / cells.mass[deep]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
    silent = cells_of_maps(region_of(scene), grid, AIR.density * full, AIR.sound_speed * full).heterogeneous
    np.testing.assert_allclose(silent.weight, np.tile(stencil.weights, (len(silent.index), 1)), atol=1e-9)


def test_a_map_moves_smoothly_with_an_obstacle():
    """Second differences of the field, of steps of a tenth of a cell, are those of a smooth function."""
    scene = small_scene(extent=16e-3)
    centers = at.cell_centers(scene)

    def field(shift):
        far = at.Sphere((8e-3 + shift, 8e-3, 8e-3), 3e-3, rigid=True).signed_distance(centers)
        lightness = (1 - torch.sigmoid(-far / 0.25e-3)) / AIR.density + torch.sigmoid(-far / 0.25e-3) / 50.0
        return at.differentiable_field(scene, DRIVE, density=1 / lightness, time_step=1.7e-6)

    fields = torch.stack([field(1e-4 * step) for step in range(4)])
    first, second = fields.diff(dim=0), fields.diff(n=2, dim=0)
    # a wave's phase changes by 4 pi / wavelength x 0.1 mm = 0.15 a step at most, forth and back
    assert second.norm(dim=1).max() < 0.15 * first.norm(dim=1).max()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: at.differentiable_field(s, DRIVE, density=[1.0, 2.0]), r"density: shape \(2,\)"),
        (lambda s: at.differentiable_field(s, DRIVE, density=[-1.0]), "density: -1.0; every entry"),
        (lambda s: at.differentiable_field(s, DRIVE, density=torch.ones(24, 24, 24)), r"must be \(1,\)"),
        (lambda s: at.differentiable_field(s, DRIVE, sound_speed=[50.0]), "cells per wavelength in"),
        (lambda s: at.differentiable_field(s, DRIVE[:2]), "drive: shape"),
        (lambda s: at.differentiable_field(s, DRIVE, [[1.0, 0, 0]]), "points"),
        (lambda s: at.differentiable_field(s, DRIVE, periods=0), "periods: 0"),
        (lambda s: at.differentiable_field(s, DRIVE, kernel="fast"), "kernel: 'fast'"),
        (lambda s: at.differentiable_field(s, DRIVE, dtype="int8"), "dtype: 'int8'"),
        (lambda s: at.differentiable_field(s, DRIVE, time_step=1.0), "time_step: 1.0 s"),
        (lambda s: at.differentiable_field("scene", DRIVE), "scene: 'scene'"),
        (
            lambda s: at.differentiable_field(small_scene(), DRIVE, density=torch.ones(2, 2, 2)),
            r"density: shape \(2, 2, 2\); must be \(24, 24, 24\)",
        ),
    ],
)  # fmt: skip
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(small_scene((at.Sphere((12e-3,) * 3, 3e-3, density=3.0, sound_speed=340.0),)))


def test_obstacles_in_the_layers_are_not_differentiated():
    scene = small_scene((SPHERE, WALL), extent=12e-3)
    density, _ = materials(SPHERE, WALL)
    with pytest.raises(ValueError, match="reaches into the absorbing layers"):
        at.differentiable_field(scene, DRIVE, density=density, **EXACT)


MEDIUM = at.Medium(density=1.2, sound_speed=340.0)
ARRAY = at.TransducerArray.grid((3, 3), 10e-3, (0, 0, 0), (1, 0, 0), radius=0)
RINGS = [at.circle_points((x, 0, 0), radius, 8, (1, 0, 0)) for x, radius in ((30e-3, 14e-3), (45e-3, 8e-3))]
BLOCK = at.Box(center=(30e-3, 0, 0), size=(12e-3, 8e-3, 6e-3), rigid=True)
SCENE = at.Scene(ARRAY, MEDIUM, 40e3, torch.cat(RINGS), [BLOCK])


def test_operator_and_scene_agree_in_a_pose():
    shift, turn = (0.6e-3, -0.6e-3, 0.5e-3), (0.06, -0.04, 0.04)  # 1 mm and 5 degrees
    body = at.TMatrix.of(BLOCK, MEDIUM, 40e3, spacing=1.5e-3, error=1e-2)
    moved = body.moved(shift, turn).transfer_matrix(ARRAY, SCENE.control_points).abs()
    exact = at.make_propagator(SCENE.moved(shift, turn), "box", 1e-3, cache=False).transfer_matrix().abs()
    # cells of 1.5 and 1 mm differ by 0.15 %, the block at rest by 6 %
    assert float((moved - exact).norm() / exact.norm()) < 0.01


def in_a_corner(*bodies, **changes):
    array = at.TransducerArray.grid((2, 2), 8e-3, (0, 0, 0), (0, 0, 1), radius=3e-3)
    corner = [at.Reflector.behind(array), at.Reflector((-12e-3, 0, 0), (1, 0, 0), -1.0)]
    parts = {"control_points": [(2e-3, 0, 20e-3)], "obstacles": bodies, "reflectors": corner} | changes
    return at.Scene(array, at.Medium.air(), 40e3, **parts)


def test_reflectors_are_in_field_and_gradient():
    """Panel and soft wall: the field as of `full`; bodies beside their images have one derivative."""
    scene = in_a_corner(at.Sphere((0, 0, 10e-3), 3e-3, density=3.0, sound_speed=300.0))
    drive = at.drive_from_phases(torch.arange(4.0))
    speed = torch.tensor([300.0], dtype=torch.float64)

    def field(density):
        return at.differentiable_field(
            scene, drive, density=density, sound_speed=speed, spacing=2.4e-3, dtype="float64", periods=40
        )

    density = torch.tensor([3.0], dtype=torch.float64, requires_grad=True)
    pressure = field(density)
    whole = at.make_propagator(scene, method="full", spacing=2.4e-3, dtype="float64", tolerance=1e-4)
    expected = whole.transfer_matrix() @ drive
    # both end within 1e-4 of the steady state; 3e-6 measured, at any spacing
    assert (pressure - expected).abs().max() < 3e-4 * expected.abs().max()
    (slope,) = torch.autograd.grad(pressure.abs().square().sum(), density)
    with torch.no_grad():
        ends = [float(field(density + step).abs().square().sum()) for step in (1e-3, -1e-3)]
    assert float(slope) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-3)


def test_reflectors_that_the_domain_cannot_have_are_refused():
    drive = torch.ones(4, dtype=torch.complex128)
    tilted = in_a_corner(reflectors=[at.Reflector((0, 0, -5e-3), (0.1, 0, 1))])
    with pytest.raises(ValueError, match=r"^scene: 'scene'; cannot have reflector 0.*along an axis"):
        at.differentiable_field(tilted, drive, spacing=2e-3)
    with pytest.raises(ValueError, match=r"density: shape.*2 reflectors; maps must be of a scene without"):
        at.differentiable_field(in_a_corner(), drive, density=torch.ones(4, 4, 4), spacing=2e-3)
    with pytest.raises(ValueError, match=r"points\[0\].*behind reflector 0"):
        at.differentiable_field(in_a_corner(), drive, [(0, 0, -1e-3)], spacing=2e-3)
