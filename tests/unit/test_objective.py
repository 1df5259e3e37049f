"""The simulated objective, and figures of merit."""

import math
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_scenes import AIR, small_scene

from autdtorch.objectives.metrics import focus_metrics
from autdtorch.objectives.objective import SimulatedObjective, _log_lost_gradient, weakest_focus
from autdtorch.propagators import FreeSpacePropagator, make_propagator
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.drive import drive_from_phases
from autdtorch.scene.scene import Scene


@pytest.fixture
def scene():
    return small_scene()


@pytest.fixture
def drive():
    phases = torch.rand(7, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return drive_from_phases(6 * phases, phases.flip(0))


@pytest.mark.parametrize("mode", ["transfer", "replay"])
def test_pressure_is_the_magnitude_of_the_field(scene, drive, mode):
    propagator = make_propagator(scene, "free_space")
    expected = propagator.field(drive, scene.control_points).abs()
    pressure = SimulatedObjective(scene, propagator, mode)(drive)
    assert pressure.dtype == torch.float64
    torch.testing.assert_close(pressure, expected, rtol=1e-13, atol=0)  # the same sum in another order


def test_transfer_simulates_once_and_replay_every_time(scene, drive):
    for mode, drives, matrices in (("transfer", 0, 1), ("replay", 9, 0)):
        real = FreeSpacePropagator(scene)
        methods = {name: getattr(real, name) for name in dir(real) if name[0] != "_"}
        counted = {name: Mock(wraps=call) for name, call in methods.items() if callable(call)}
        propagator = SimpleNamespace(**methods | counted)  # Python 3.12 sees no attributes of a Mock
        objective = SimulatedObjective(scene, propagator, mode)
        objective(drive)
        objective(drive[:2])
        assert propagator.field.call_count == drives  # one by one
        assert propagator.transfer_matrix.call_count == matrices
        assert objective.evaluations == 9


def test_a_row_does_not_depend_on_the_rows_beside_it(scene, drive):
    objective = SimulatedObjective(scene, make_propagator(scene, "free_space"))
    together = objective(drive.repeat(50, 1))
    assert torch.equal(together[:7], torch.cat([objective(row[None]) for row in drive]))
    assert torch.equal(together[:7], together[-7:])
    assert torch.equal(together[:7], objective(drive.T.contiguous().T))


@pytest.mark.parametrize("mode", ["transfer", "replay"])
@pytest.mark.parametrize("leading", [(), (1,), (6,), (2, 3), (1, 3, 2)])
def test_leading_dimensions_are_those_of_the_drives(scene, drive, mode, leading):
    objective = SimulatedObjective(scene, make_propagator(scene, "free_space"), mode)
    count = math.prod(leading)
    pressure = objective(drive[:count].reshape(*leading, 4))
    assert objective.evaluations == count
    assert torch.equal(pressure, objective(drive[:count]).reshape(*leading, 3))


def test_a_row_does_not_depend_on_the_number_of_threads(set_threads):
    # 340204 products: wherever a thread begins it is in the middle of a row.
    array = TransducerArray.grid((17, 1), pitch=10e-3, center=(0, 0, 0))
    points = torch.tensor([(80e-3, 1e-2 * y, 0.0) for y in range(4)])
    scene = Scene(array, AIR, frequency=40e3, control_points=points)
    objective = SimulatedObjective(scene, make_propagator(scene, "free_space"))
    phases = torch.rand(5003, 17, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    drive = drive_from_phases(6 * phases)
    set_threads(1)
    expected = objective(drive)
    for count in range(2, 11):
        set_threads(count)
        assert torch.equal(objective(drive), expected)


def test_the_end_of_a_gradient_is_logged_once_and_the_docstring_has_the_way_around(scene, drive, caplog):
    _log_lost_gradient.cache_clear()
    propagator = make_propagator(scene, "free_space")
    objective = SimulatedObjective(scene, propagator)
    objective(drive)
    assert not caplog.records
    by_drive = drive.clone().requires_grad_()
    observed = objective(by_drive)
    objective(by_drive)
    assert not observed.requires_grad
    (record,) = caplog.records
    assert "the drive's is lost; propagator.field(drive, points)" in record.message
    # d|p|/dq of one drive, through both ways that the docstring names
    gradients = []
    for pressure in (
        propagator.field(by_drive, scene.control_points),
        by_drive @ objective.transfer_matrix.mT,
    ):
        torch.testing.assert_close(pressure.detach().abs(), observed)
        gradients += torch.autograd.grad(weakest_focus(pressure.abs()).sum(), by_drive)
    assert gradients[0].abs().max() > 0
    torch.testing.assert_close(*gradients)


def test_an_unknown_mode_is_refused(scene):
    with pytest.raises(ValueError, match=r"mode: 'guess'; must be"):
        SimulatedObjective(scene, make_propagator(scene, "free_space"), "guess")


pressures = st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=6)


def plane_distances(size, cells):
    """Distances (cells, cells) of the cells of a square plane from its centre."""
    along = size * ((torch.arange(cells, dtype=torch.float64) + 0.5) / cells - 0.5)
    return torch.hypot(along[:, None], along[None, :])


def test_figures_of_known_pressures():
    metrics = focus_metrics([[1.0, 3.0], [2.0, 2.0], [0.0, 0.0]])
    assert metrics.mean.tolist() == [2.0, 2.0, 0.0]
    assert metrics.min.tolist() == [1.0, 2.0, 0.0]
    assert metrics.std.tolist() == [1.0, 0.0, 0.0]  # of the population: the foci are all there are
    assert metrics.uniformity.tolist() == [0.5, 1.0, 1.0]
    assert metrics.area is None
    plane = torch.tensor([[[1.0, 0.0]], [[1.0, 1.0]], [[0.0, 0.0]]])
    area = focus_metrics(torch.ones(3, 2), plane, 4.0).area
    assert area.tolist() == [2.0, 4.0, 0.0]


@given(pressures, st.floats(1e-3, 1e3), st.randoms())
def test_louder_foci_in_another_order_are_louder_by_exactly_that(pressure, factor, random):
    louder = [factor * p for p in random.sample(pressure, len(pressure))]
    metrics, other = focus_metrics(pressure), focus_metrics(louder)
    for name, power in (("mean", 1), ("min", 1), ("std", 1), ("uniformity", 0)):
        # Sums of at most six terms in another order; a std near 0 is the rounding of the mean.
        expected = getattr(metrics, name) * factor**power
        torch.testing.assert_close(getattr(other, name), expected, rtol=1e-12, atol=1e-12 * max(louder))


@pytest.mark.parametrize(
    ("shape", "radius", "foci"),
    [
        (lambda distance: (distance < 20e-3).double(), 20e-3, 4),
        # Half the intensity of a Gaussian focus: exp(-r^2 / 2w^2) = 1 / sqrt(2) at r^2 = w^2 log 2.
        (lambda distance: torch.exp(-(distance**2) / 2e-4), 10e-3 * math.sqrt(math.log(2)), 1),
    ],
    ids=["disc", "gaussian"],
)
def test_the_area_within_half_the_intensity_is_shared_among_the_foci(shape, radius, foci):
    cells, size = 400, 100e-3
    cell = size / cells
    area = focus_metrics([1.0] * foci, shape(plane_distances(size, cells)), cell**2).area
    # Only cells cut by the circle can be wrong, about 8 radius / cell of them, and on average by nothing.
    assert foci * area.item() == pytest.approx(math.pi * radius**2, abs=8 * radius * cell)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1.0, -0.5],), r"pressure: -0\.5 Pa; every magnitude must be >= 0"),
        ((1.0,), r"pressure: shape \(\); must be \(\.\.\., P\)"),
        (([],), r"pressure: shape \(0,\)"),
        (([1.0], [[1.0]]), "cell_area: None"),
        (([1.0], None, 1.0), "plane_pressure: None"),
        (([1.0], [1.0], 1.0), r"plane_pressure: shape \(1,\)"),
        (([[1.0], [2.0]], [[1.0]], 1.0), r"plane_pressure: shape \(1, 1\); must be \(2, Nu, Nv\)"),
        (([1.0], [[1.0]], 0.0), r"cell_area: 0\.0 m\^2"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        focus_metrics(*arguments)
