"""Changes of a scene that a calibration finds: of points, temperature, the array and bodies."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from noisy_bench import Bench, array, scene

import autdtorch as at
from autdtorch.propagators.scene_changes import SceneChanges


def test_changes_of_a_microphone_do_not_move_other_points():
    simulated = at.make_propagator(scene())
    readings = Bench(SceneChanges(simulated, ["points[1].y"]).matrix([2e-3]), 14).readings(60)
    calibration = at.calibrate(simulated, readings, at.Prior(variants={"points[1].y": 2e-3}), folds=0)
    place = simulated.scene.control_points[1]
    moved = place + torch.tensor([0.0, calibration.amounts["points[1].y"].value, 0.0])
    alone, beside = (
        calibration.predict(readings.drives, p) for p in (moved[None], torch.stack([place, moved]))
    )
    assert torch.allclose(alone.pressure[:, 0], beside.pressure[:, 1])
    matrix = at.make_propagator(calibration.scene).transfer_matrix(moved[None])
    expected = (readings.drives @ matrix.T).abs()
    assert torch.allclose(alone.pressure, expected, rtol=1e-6)


BALLS = [at.Sphere((40e-3, side, 0.0), 6e-3, rigid=True) for side in (-9e-3, 9e-3)]


@pytest.mark.parametrize(
    ("bodies", "names"),
    [
        ((), {"points.x": 1e-3, "points.z": 1e-3}),
        ((), {"temperature": 3.0, "array.y": 1e-3}),
        (BALLS, {"obstacles.x": 1e-3, "obstacles.y": 1e-3, "obstacles.turn_z": 0.05}),
    ],
)
def test_named_changes_are_found(bodies, names):
    simulated = at.make_propagator(scene(obstacles=bodies))
    amounts = {name: 1.3 * width for name, width in names.items()}
    true = SceneChanges(simulated, [*names]).matrix([*amounts.values()])
    bench = Bench(true, 9, gain=0.02, phase=0.05)
    prior = at.Prior(variants=names, gain=0.02, phase=0.05, rest=0.01)
    calibration = at.calibrate(simulated, bench.readings(150), prior, folds=0)
    for name, (value, deviation) in calibration.amounts.items():
        assert deviation < names[name]
        assert abs(value - amounts[name]) < 4 * deviation


@settings(deadline=None, max_examples=3)
@given(aside=st.floats(2.5e-3, 4.5e-3), side=st.sampled_from([1, -1]), seed=st.integers(0, 10**6))
def test_a_body_nearly_half_a_wavelength_aside_is_found(aside, side, seed):
    """The echo between it and the panel is alike there: the posterior has a maximum each half wavelength."""
    ball = at.Sphere((25e-3, 2e-3, -1e-3), radius=4e-3, rigid=True)
    room = scene(obstacles=[ball], reflectors=[at.Reflector.behind(array())])
    simulated = at.make_propagator(room, method="tmatrix", tolerance=1e-5)
    true = SceneChanges(simulated, ["obstacles.x"]).matrix([side * aside])
    bench = Bench(true, seed, phase=0.3)
    prior = at.Prior(variants={"obstacles.x": 2e-3}, phase=0.3, rest=0.02)
    calibration = at.calibrate(simulated, bench.readings(60), prior, folds=0)
    value, deviation = calibration.amounts["obstacles.x"]
    assert abs(value - side * aside) < 5 * deviation  # a wrong maximum is 20 or more off


def test_half_wavelengths_that_grids_do_not_look_at_are_told():
    ball = at.Sphere((25e-3, 2e-3, -1e-3), radius=4e-3, rigid=True)
    simulated = at.make_propagator(scene(obstacles=[ball], shape=(2, 2)), method="box", spacing=2e-3)
    drives = torch.eye(4, dtype=torch.complex128).repeat(2, 1)
    readings = at.Readings(drives, (drives @ simulated.transfer_matrix().T).abs())
    for width in (1e-3, 2e-3):
        prior = at.Prior(variants={"obstacles.x": width})
        doubts = at.calibrate(simulated, readings, prior, folds=0).doubts
        assert any("half a wavelength" in doubt for doubt in doubts) == (width > 1e-3)
