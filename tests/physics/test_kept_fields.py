"""Fields that a box keeps, and matrices of planes: more points, planes and drives take no runs."""

from dataclasses import replace

import pytest
import torch
from small_scenes import AIR, CUBE, relative_error, small_scene

from autdtorch.propagators import kept_matrices, make_propagator
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Sphere
from autdtorch.scene.scene import Scene

SETTLED = 1e-5  # Tolerance of runs
# Runs that begin at points and at transducers have other errors of the grid: 3e-4 was measured at 1.3 mm
SAME = 2e-3
ASIDE = replace(CUBE, center=(12e-3, 12.7e-3, 11.6e-3))  # no transducer is the image of another
PLANE = torch.cartesian_prod(*(1e-3 * torch.arange(5).double() for _ in range(2)))
PLANE = torch.cat((torch.full((25, 1), 20e-3, dtype=torch.float64), 10e-3 + PLANE), dim=1)
DRIVE = torch.polar(torch.ones(4, dtype=torch.float64), torch.arange(4, dtype=torch.float64))


def box(obstacles):
    settings = {"tolerance": SETTLED, "dtype": "float64", "cache": False}
    return make_propagator(small_scene(obstacles), "box", 1.3e-3, **settings)


@pytest.mark.parametrize(
    ("obstacles", "runs"),
    [
        ((ASIDE,), [3, 4, 0, 0]),  # three points, then four transducers
        ((CUBE,), [1, 0, 0, 0]),  # one transducer stands for all
    ],
)
def test_points_that_follow_take_no_runs(obstacles, runs):
    propagator, found = box(obstacles), []
    points = [propagator.scene.control_points, PLANE[:3], PLANE[9:12], PLANE]
    for some in points:
        before = len(propagator.runs)
        matrix = propagator.transfer_matrix(some)
        found.append(len(propagator.runs) - before)
        assert relative_error(matrix, box(obstacles).transfer_matrix(some)) < SAME
    assert found == runs
    before = len(propagator.runs)
    field = propagator.field(DRIVE, PLANE.reshape(5, 5, 3))
    assert len(propagator.runs) == before
    assert relative_error(field, box(obstacles).field(DRIVE, PLANE.reshape(5, 5, 3))) < SAME


def test_a_second_plane_of_a_drive_takes_no_run():
    propagator, other = box((ASIDE,)), PLANE + 1e-3
    propagator.field(DRIVE, PLANE)
    assert len(propagator.runs) == 1
    field = propagator.field(torch.stack((1j * DRIVE, DRIVE)), other)
    assert len(propagator.runs) == 2  # of the drive that is new
    assert relative_error(field[1:], box((ASIDE,)).field(DRIVE[None], other)) < SAME
    assert relative_error(field[0], 1j * field[1]) < SAME


def test_points_within_the_box_are_simulated():
    """Between the obstacle and the surface that radiates: where the grid is read."""
    propagator, beside = box((ASIDE,)), torch.tensor([[12e-3, 12e-3, 14.4e-3]], dtype=torch.float64)
    propagator.transfer_matrix(PLANE)
    before = len(propagator.runs)
    found = propagator.transfer_matrix(torch.cat((beside, PLANE[:1])))
    assert len(propagator.runs) > before
    assert relative_error(found, box((ASIDE,)).transfer_matrix(torch.cat((beside, PLANE[:1])))) < SAME


def test_coupled_boxes_keep_their_fields():
    array = TransducerArray.grid((1, 2), pitch=8e-3, center=(1e-3, 35e-3, 35e-3))
    near = torch.tensor([13.8e-3, 15.2e-3, 15.2e-3], dtype=torch.float64)
    spheres = [Sphere(tuple(near + apart), 4e-3, rigid=True) for apart in (0.0, 45e-3)]
    scene = Scene(array, AIR, 40e3, [[61e-3, 32e-3, 35e-3], [63e-3, 30e-3, 35e-3]], spheres)

    def apart():
        return make_propagator(scene, "box", 1.4e-3, tolerance=1e-3, cache=False)

    propagator, others = apart(), scene.control_points + 1e-3
    assert len(propagator._simulation.boxes) == 2
    for _ in range(2):
        propagator.transfer_matrix(others)
    before = len(propagator.runs)
    found = propagator.transfer_matrix()
    assert len(propagator.runs) == before
    assert relative_error(found, apart().transfer_matrix()) < SAME


def test_discs_keep_their_fields():
    scene = small_scene((Box((12e-3, 12.4e-3, 12e-3), (5e-3,) * 3, rigid=True),), radius=2e-3)

    def discs():
        return make_propagator(scene, "box", 1.3e-3, tolerance=SETTLED, dtype="float64", cache=False)

    propagator = discs()
    propagator.transfer_matrix(PLANE)
    before = len(propagator.runs)
    found = propagator.transfer_matrix()
    assert len(propagator.runs) == before
    assert relative_error(found, discs().transfer_matrix()) < SAME


def test_what_a_cache_holds_changes_no_field(tmp_path):
    """Beside a cache nothing is kept: a resumed study finds the fields of one that never stopped."""
    found = []
    for _ in range(2):  # simulated, then loaded
        settings = {"tolerance": 1e-3, "cache": tmp_path}
        propagator = make_propagator(small_scene((ASIDE,)), "box", 1.3e-3, **settings)
        for points in (PLANE[:3], PLANE[3:6], PLANE[6:9]):
            propagator.transfer_matrix(points)
        found.append(propagator.field(DRIVE, PLANE + 1e-3))
    assert torch.equal(*found)


ACROSS = torch.stack(
    torch.meshgrid(*(2e-3 * torch.arange(4.0, 10).double() for _ in range(2)), indexing="ij")
)
ACROSS = torch.stack((*ACROSS, torch.full_like(ACROSS[0], 12.3e-3)), dim=-1)  # a plane through the obstacle


@pytest.mark.parametrize("method", ["box", "full", "operator"])
@pytest.mark.parametrize("plane", [PLANE.reshape(5, 5, 3), ACROSS], ids=["behind", "across"])
def test_the_matrix_of_a_plane_is_kept_once_its_drives_took_as_many_runs(method, plane):
    def new():
        return make_propagator(small_scene((ASIDE,)), method, 1.3e-3, SETTLED, dtype="float64", cache=False)

    propagator, runs = new(), []
    drives = torch.stack([DRIVE**power for power in range(1, 8)])
    for drive in drives:
        before = len(propagator.runs)
        field = propagator.field(drive, plane)
        runs.append(len(propagator.runs) - before)
    assert runs == [1, 1, 1, 1, 4, 0, 0]  # a run for each of the four transducers
    one = new().field(drives[-1], plane)  # simulated as a drive
    assert relative_error(field, one) < SAME


BYTES = 16 * 25 * 4  # of the matrix of a plane


def runs_of_single_drives(monkeypatch, most_bytes, planes):
    """Return the propagator, the runs of each call and the most bytes kept, where so many may be."""
    monkeypatch.setattr(kept_matrices, "_MOST_BYTES", most_bytes)
    propagator = make_propagator(small_scene((ASIDE,)), "full", 1.3e-3, tolerance=1e-1, cache=False)
    runs, kept = [], []
    for power, plane in enumerate(planes):
        before = len(propagator.runs)
        propagator.field(DRIVE**power, plane.reshape(5, 5, 3))
        runs.append(len(propagator.runs) - before)
        kept.append(propagator._kept.bytes)
    return propagator, runs, max(kept)


def test_a_matrix_that_is_too_large_is_not_kept_and_never_simulated_for_drives(monkeypatch):
    propagator, runs, most = runs_of_single_drives(monkeypatch, BYTES - 1, [PLANE] * 7)
    assert (runs, most) == ([1] * 7, 0)
    matrix = propagator.transfer_matrix(PLANE)
    assert propagator._kept.bytes == 0
    before = len(propagator.runs)
    assert torch.equal(propagator.transfer_matrix(PLANE), matrix)
    assert len(propagator.runs) == before + 4


def test_planes_that_do_not_all_fit_take_at_most_two_runs_a_drive(monkeypatch):
    planes = [PLANE, PLANE + 1e-3] * 12
    _, runs, most = runs_of_single_drives(monkeypatch, 2 * BYTES - 1, planes)
    assert most == BYTES
    assert sum(runs) <= 2 * len(planes)
    _, runs, most = runs_of_single_drives(monkeypatch, 2 * BYTES, planes)
    assert most == 2 * BYTES
    assert sum(runs) == 2 * (4 + 4)  # of drives, then of both matrices


def test_runs_of_few_planes_are_counted(monkeypatch):
    monkeypatch.setattr(kept_matrices, "_MOST_PLANES", 3)
    kept = kept_matrices.KeptMatrices(4)
    for moved in range(5):
        kept.count(PLANE + moved, 1)
        kept.count(PLANE, 1)
    assert len(kept._runs) == 3
    assert [kept.runs(PLANE + moved) for moved in range(5)] == [6, 0, 0, 1, 1]


def test_a_matrix_is_held_once(monkeypatch):
    """The one simulated is the one kept; the caller gets a copy, unless it is not kept."""
    propagator, points = box((ASIDE,)), PLANE[:3]
    made = []
    simulate = propagator._simulation.transfer_matrix
    monkeypatch.setattr(
        propagator._simulation, "transfer_matrix", lambda given: made.append(simulate(given)) or made[-1]
    )
    found = propagator.transfer_matrix(points)
    assert propagator._kept.get(points) is made[0]
    assert found.data_ptr() != made[0].matrix.data_ptr()
    monkeypatch.setattr(kept_matrices, "_MOST_BYTES", 0)
    assert propagator.transfer_matrix(PLANE[3:6]).data_ptr() == made[1].matrix.data_ptr()


def test_a_matrix_made_without_gradients_serves_calls_with_them():
    propagator, drive = box((ASIDE,)), DRIVE.clone().requires_grad_()
    with torch.inference_mode():
        propagator.transfer_matrix()
    before = len(propagator.runs)
    propagator.field(drive, propagator.scene.control_points).abs().sum().backward()
    assert len(propagator.runs) == before
    assert drive.grad.abs().max() > 0


@pytest.mark.parametrize("method", ["box", "full"])
def test_gradients_at_known_points_take_no_runs(method):
    propagator = make_propagator(small_scene((ASIDE,)), method, 1.3e-3, tolerance=1e-2, cache=False)
    points, drive = propagator.scene.control_points, DRIVE.clone().requires_grad_()
    propagator.transfer_matrix()
    before, fields = len(propagator.runs), []
    for _ in range(3):
        fields.append(propagator.field(drive, points))
        fields[-1].abs().amin().backward()
    assert len(propagator.runs) == before
    assert drive.grad.abs().max() > 0
    matrix = propagator.transfer_matrix(points)
    matrix.zero_()  # the caller's own
    assert torch.equal(propagator.field(drive, points), fields[0])


def test_beside_a_cache_earlier_drives_decide_nothing(tmp_path):
    plane = PLANE.reshape(5, 5, 3)
    propagator = make_propagator(small_scene((ASIDE,)), "full", 1.3e-3, tolerance=1e-2, cache=tmp_path)
    fields = [propagator.field(DRIVE, plane) for _ in range(6)]
    assert len(propagator.runs) == 6
    assert all(torch.equal(field, fields[0]) for field in fields)
