"""Calibration of a simulation by readings of a simulated bench that differs from it."""

import dataclasses
import math
import re

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from noisy_bench import Bench, error, scene

import autdtorch as at
from autdtorch.propagators.scene_changes import SceneChanges


@pytest.fixture(scope="module")
def matrix():
    return at.make_propagator(scene()).transfer_matrix()


@pytest.mark.parametrize("unit", [1e-3, 1.0, 400.0])
def test_gains_and_phases_are_those_of_the_bench(matrix, unit):
    bench = Bench(matrix, 1, unit=unit)
    calibration = at.calibrate(matrix, bench.readings(120), at.Prior(rest=0.01))
    # 360 readings of 34 unknowns with 3 % noise: 0.03 / sqrt(360 / 34) = 1 % of the matrix
    assert error(calibration, bench.matrix) < 0.03
    off = (calibration.gain.log() - bench.log_gain) / calibration.gain_deviation
    # The scale takes the mean of the gains in part; of 16 deviates one in 20 is beyond 2.
    assert (off - off.mean()).abs().max() < 4
    assert calibration.scale.value == pytest.approx(unit, rel=4 * calibration.scale.deviation / unit + 0.01)
    held = calibration.held_back
    assert held.error < 0.5 * held.before
    assert 0.85 < held.coverage <= 1  # of 360, 95 % +- 1.1 % are expected


@settings(deadline=None, max_examples=5)
@given(st.integers(0, 10**6), st.booleans(), st.sampled_from([1, 3]))
def test_calibration_predicts_readings_it_has_not_seen(seed, phase, points):
    matrix = at.make_propagator(scene(points)).transfer_matrix()
    bench = Bench(matrix, seed)
    calibration = at.calibrate(matrix, bench.readings(150, phase), at.Prior(rest=0.01), folds=0)
    drives = bench.drives(200)
    prediction, truth = calibration.predict(drives), (drives @ bench.matrix.T).abs()
    inside = (prediction.pressure - truth).abs() < 3 * prediction.deviation + 0.5 * bench.noise
    assert inside.double().mean() > 0.95
    # Noise of 3 % on 150 readings or more, of at most 34 unknowns
    assert (prediction.pressure - truth).norm() < 0.05 * truth.norm()


def test_phases_determine_more_than_magnitudes(matrix):
    bench = Bench(matrix, 3)
    readings = bench.readings(12, phase=True)
    turned = dataclasses.replace(readings, phase=readings.phase + 2.5)  # the phase of the trigger is unknown
    plain = at.calibrate(matrix, dataclasses.replace(readings, phase=None), at.Prior(rest=0.01), folds=0)
    with_phase = at.calibrate(matrix, turned, at.Prior(rest=0.01), folds=0)
    assert error(with_phase, bench.matrix) < 0.6 * error(plain, bench.matrix)
    assert with_phase.phase_deviation.mean() < plain.phase_deviation.mean()


def test_outliers_are_named_and_left_out(matrix):
    bench = Bench(matrix, 4)
    readings = bench.readings(60)
    broken = [(3, 0), (17, 2), (40, 1)]
    pressure = readings.pressure.clone()
    for place in broken:
        pressure[place] *= 100
    calibration = at.calibrate(matrix, dataclasses.replace(readings, pressure=pressure), folds=0)
    assert set(broken) <= set(calibration.outliers)
    assert len(calibration.outliers) <= 5
    clean = at.calibrate(matrix, readings, folds=0)
    assert error(calibration, bench.matrix) < 1.3 * error(clean, bench.matrix) + 0.01


def test_wrong_phases_are_named_and_left_out():
    simulated = at.make_propagator(scene())
    true = SceneChanges(simulated, ["temperature"]).matrix([4.0])  # takes several linearisations
    readings = Bench(true, 4, gain=0.02, phase=0.05).readings(60, phase=True)
    phase = readings.phase.clone()
    broken = [(3, 0), (17, 2)]
    for place in broken:
        phase[place] += 3.0
    prior = at.Prior(variants={"temperature": 3.0}, gain=0.02, phase=0.05, rest=0.01)
    calibration = at.calibrate(simulated, dataclasses.replace(readings, phase=phase), prior, folds=0)
    assert calibration.outliers == broken


def test_gaps_are_no_readings(matrix):
    bench = Bench(matrix, 5)
    readings = bench.readings(60)
    pressure = readings.pressure.clone()
    pressure[::3, 1] = torch.nan
    calibration = at.calibrate(matrix, dataclasses.replace(readings, pressure=pressure), at.Prior(rest=0.01))
    assert error(calibration, bench.matrix) < 0.08
    assert not calibration.outliers
    assert calibration.held_back.readings == 160


@pytest.mark.parametrize("shift", [-2, 1])
def test_shifted_rows_are_refused(matrix, shift):
    readings = Bench(matrix, 6, phase=0.2).readings(60)
    pairs = (
        rf"drives\[:{-shift}\] .* pressure\[{shift}:\]"
        if shift > 0
        else rf"drives\[{-shift}:\] .* pressure\[:{shift}\]"
    )
    with pytest.raises(ValueError, match=pairs):
        at.calibrate(matrix, dataclasses.replace(readings, pressure=readings.pressure.roll(shift, 0)))


def test_phases_of_the_other_sign_are_refused(matrix):
    readings = Bench(matrix, 6, phase=0.2).readings(60)
    with pytest.raises(ValueError, match="phases of the other sign"):
        at.calibrate(matrix, dataclasses.replace(readings, drives=readings.drives.conj()))


def test_interchanged_sensors_and_another_unit_are_doubted(matrix):
    readings = Bench(matrix, 6, phase=0.2).readings(60)
    interchanged = dataclasses.replace(readings, pressure=1000 * readings.pressure[:, [1, 0, 2]])
    doubts = at.calibrate(matrix, interchanged, folds=0).doubts
    assert "point 0 does not follow the drives, and is left out: it reads as point 1 should" in doubts[0]
    assert "pressures or points in another unit" in doubts[2]


def test_transducers_in_another_order_are_doubted(matrix):
    readings = Bench(matrix, 6, phase=0.2).readings(60)
    mixed = dataclasses.replace(readings, drives=readings.drives.roll(3, dims=1))
    assert "in another order" in " ".join(at.calibrate(matrix, mixed).doubts)


@pytest.mark.parametrize(("silent", "points"), [((3, 9), 1), ((5,), 3)])
def test_silent_transducers_are_named(silent, points):
    matrix = at.make_propagator(scene(points)).transfer_matrix()
    bench = Bench(matrix, 8)
    bench.matrix[:, silent] = 0
    calibration = at.calibrate(matrix, bench.readings(150 // points))
    (doubt,) = calibration.doubts
    # that of the others, of which the fit takes a part for noise; with the silent ones it is 12 to 23 %
    assert float(re.search(r"gains +spread ([\d.]+) %", calibration.summary())[1]) < 8
    named = f"transducers {silent[0]}, {silent[1]} are" if len(silent) > 1 else f"transducer {silent[0]} is"
    assert doubt.startswith(f"{named} silent, or below")


def test_weak_and_idle_transducers_are_not_silent(matrix):
    bench = Bench(matrix, 8)
    bench.matrix[:, 2] *= 0.6
    readings = bench.readings(60)
    readings.drives[:, 7] = 0
    readings.pressure[:] = bench.pressure(readings.drives).abs()
    assert not at.calibrate(matrix, readings, folds=0).doubts


def test_saturated_readings_do_not_count_as_errors(matrix):
    readings = Bench(matrix, 6).readings(60)
    pressure = readings.pressure.clamp(max=float(readings.pressure.median()))
    held = at.calibrate(matrix, dataclasses.replace(readings, pressure=pressure)).held_back
    assert held.readings < 0.6 * readings.count
    assert held.error < 0.1  # with the saturated ones, 0.4 or more


def test_widths_in_millimetres_are_refused():
    propagator = at.make_propagator(scene())
    readings = at.Readings(
        torch.ones(2, 16, dtype=torch.complex128), torch.ones(2, len(scene().control_points))
    )
    with pytest.raises(ValueError, match=r"'points.x': 2 m; must be at most 0.1 m"):
        at.calibrate(propagator, readings, at.Prior(variants={"points.x": 2.0}))


def test_a_failed_microphone_is_named_and_left_out(matrix, caplog):
    bench = Bench(matrix, 7)
    readings = bench.readings(60)
    pressure = readings.pressure.clone()
    pressure[:, 1] = 0.3 + 0.01 * torch.rand(60, dtype=torch.float64, generator=bench.draws)
    calibration = at.calibrate(matrix, dataclasses.replace(readings, pressure=pressure), folds=0)
    assert "point 1 does not follow the drives" in calibration.doubts[0]
    others = [0, 2]
    turn = (calibration.transfer_matrix.conj() * bench.matrix)[others].sum(dim=1, keepdim=True).sgn()
    off = calibration.transfer_matrix[others] * turn - bench.matrix[others]
    assert off.norm() < 0.15 * bench.matrix[others].norm()


def test_repeats_and_gaps_of_a_point_are_no_failed_microphone(matrix):
    bench = Bench(matrix, 12)
    drives = bench.drives(1).expand(40, -1)
    repeats = at.Readings(drives, bench.pressure(drives).abs())
    assert not at.calibrate(matrix, repeats, folds=0).doubts
    readings = bench.readings(40)
    readings.pressure[:, 1] = torch.nan
    assert not at.calibrate(matrix, readings, folds=0).doubts


@pytest.mark.parametrize("folds", [5, 7])
def test_each_reading_is_held_back_once(matrix, folds):
    readings = Bench(matrix, 13).readings(16)
    readings.pressure[::2, 1] = torch.nan
    held = at.calibrate(matrix, readings, folds=folds).held_back
    assert torch.equal(held.predicted.isnan(), readings.pressure.isnan())
    assert held.readings == 40


def test_symmetric_drives_show_sums_of_their_transducers_only(matrix):
    bench = Bench(matrix[1:2], 8, phase=0.1)
    drives = bench.drives(80)
    drives[:, 8:] = drives[:, :8].flip(1)  # the point lies in the plane of symmetry
    middle = torch.tensor([[80e-3, 0.0, 0.0]], dtype=torch.float64)
    symmetric = at.make_propagator(dataclasses.replace(scene(), control_points=middle)).transfer_matrix()
    readings = at.Readings(drives, (drives @ symmetric.T).abs())
    calibration = at.calibrate(symmetric, readings, folds=0)
    assert sorted(map(len, calibration.together)) == [2] * 8
    assert calibration.determined < 17


def test_the_prior_for_methods_varies_the_calibrated_matrix():
    simulated = at.make_propagator(scene())
    names = {"points.y": 1e-3}
    bench = Bench(simulated.transfer_matrix(), 11)
    calibration = at.calibrate(simulated, bench.readings(60), at.Prior(variants=names), folds=0)
    value, deviation = calibration.amounts["points.y"]
    changes = SceneChanges(simulated, [*names])
    here, aside = changes.matrix([value]), changes.matrix([value + 0.01 * deviation])
    relative = (aside - here) / here  # gains, phases and the scale cancel, and only entries do not
    variant = calibration.prior.variants[0] / calibration.transfer_matrix - 1
    assert (variant - 100 * relative).norm() < 0.1 * variant.norm()


def test_nothing_is_predicted_within_a_rigid_obstacle():
    box = at.Box((40e-3, 0.0, 0.0), (20e-3, 20e-3, 20e-3), rigid=True)
    settings = {"spacing": 2e-3, "tolerance": 0.1, "cache": False}
    simulated = at.make_propagator(scene(1, (2, 2), obstacles=(box,)), **settings)
    readings = Bench(simulated.transfer_matrix(), 15).readings(8)
    prediction = at.calibrate(simulated, readings, folds=0).predict(readings.drives, [[40e-3, 0.0, 0.0]])
    assert not prediction.pressure.any()
    assert not prediction.deviation.any()


def test_a_scan_of_a_plane_is_one_drive_at_many_points():
    y, z = torch.meshgrid(*2 * [torch.linspace(-20e-3, 20e-3, 12, dtype=torch.float64)], indexing="ij")
    points = torch.stack([torch.full_like(y, 60e-3), y, z], dim=-1).reshape(-1, 3)
    simulated = at.make_propagator(scene(1))
    bench = Bench(simulated.transfer_matrix(points), 10)
    drive = bench.drives(1)
    readings = at.Readings(drive, bench.pressure(drive).abs(), points)
    calibration = at.calibrate(simulated, readings, at.Prior(rest=0.01))
    assert calibration.held_back.error < 0.5 * calibration.held_back.before
    elsewhere = calibration.predict(drive, points[:4] + 1e-3)
    assert elsewhere.pressure.shape == (1, 4)
    assert (elsewhere.deviation < elsewhere.pressure.mean()).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"folds": 1}, "folds: 1; must be 0, or 2 to"),
        (
            {"readings": at.Readings(torch.ones(3, 16).to(torch.complex128), torch.zeros(3, 3))},
            "at least one reading above 0 Pa",
        ),
        (
            {"readings": at.Readings(torch.zeros(3, 16).to(torch.complex128), torch.ones(3, 3))},
            "propagator_or_matrix: 0; must make a pressure",
        ),
        ({"prior": at.Prior(torch.ones(3, 16, dtype=torch.complex128))}, "prior.transfer_matrix"),
        ({"prior": at.Prior(variants={"points.x": 1e-3})}, "prior.variants: .*names need a propagator"),
        ({"readings": "readings.csv"}, "readings: 'readings.csv'"),
        (
            {"readings": at.Readings(torch.ones(3, 5).to(torch.complex128), torch.ones(3, 3))},
            "5 transducers; must be 3 and 16",
        ),
    ],
)
def test_wrong_arguments_are_refused(matrix, settings, message):
    arguments = {"readings": Bench(matrix, 0).readings(5), **settings}
    with pytest.raises(ValueError, match=message):
        at.calibrate(matrix, **arguments)


def test_a_table_of_rms_pressures_becomes_a_better_drive_in_six_lines(tmp_path):
    simulated = scene(4)
    bench = Bench(at.make_propagator(simulated).transfer_matrix(), 11)
    readings = bench.readings(200)
    titles = [f"phase {n} [deg]" for n in range(16)] + [f"pressure {n} [Pa rms]" for n in range(4)]
    rows = torch.cat([at.phases_of(readings.drives).rad2deg(), readings.pressure / math.sqrt(2)], dim=1)
    text = [",".join(titles), *(",".join(f"{number:.5g}" for number in row) for row in rows.tolist())]
    (tmp_path / "bench.csv").write_text("\n".join(text), encoding="utf-8")
    at.save_scene(tmp_path / "scene.yaml", simulated)

    propagator = at.make_propagator(at.load_scene(tmp_path / "scene.yaml"))
    readings = at.load_readings(tmp_path / "bench.csv")
    calibration = at.calibrate(propagator, readings, folds=0)
    drive = at.gradient_ascent(calibration.transfer_matrix).drive[0]
    at.save_drive(tmp_path / "drive.csv", drive, propagator.scene.array)

    played = at.load_drive(tmp_path / "drive.csv")
    weakest, before, best = (
        float((bench.matrix @ each).abs().min())
        for each in (
            played,
            at.gradient_ascent(propagator.transfer_matrix()).drive[0],
            at.gradient_ascent(bench.matrix).drive[0],
        )
    )
    # Entries are known to 1 % (800 readings of 34 unknowns, 3 % noise); phases of 0.5 rad cost far more
    assert before < 0.9 * best
    assert weakest > 0.97 * best
