"""Free space, and its calibration by readings, against public measurements.

DATA are clones of github DigitalNatureGroup/insitu_optimization (research only) and of
upnalab/usarrayheightmod (MIT), or an npz file of the latter's scans. Errors are rms, over the rms reading.
Those of a calibration are at readings that it did not see, without a further gain.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from shared.document import Page, percent, printed, table
from shared.hologram_readings import AUTHORS_RADIUS, KINDS, LEVELS, TARGETS, TRIES, Holograms, matrix, scene
from shared.hologram_readings import MARKS as HOLOGRAM_MARKS
from shared.scans import MARK as SCAN_MARK
from shared.scans import RADIUS, Scan, load_scans

import autdtorch as at

DOCUMENT = "measured.md"
OPTIONS = {"data": {"nargs": "+", "type": Path, "metavar": "DATA", "help": "clone, or npz file of scans"}}

FEW = 10
"""Readings of the calibration whose drives are judged by the calibration of all readings."""
MOVES = 3000
"""Most steps of one transducer by one phase level, of the search of a drive."""


def main(data: Sequence[Path], page: Page) -> None:
    parts = [part for path in data for part in parts_of(path)]
    page.write(*parts)


def parts_of(path: Path) -> Iterator[str]:
    """Yield the paragraphs and tables of a data set."""
    if all((path / mark).is_dir() for mark in HOLOGRAM_MARKS):
        yield from hologram_parts(Holograms(path))
    elif (path / SCAN_MARK).is_dir() or (path.suffix == ".npz" and path.is_file()):
        yield from scan_parts(load_scans(path))
    else:
        sys.exit(f"{path}: must be a clone of insitu_optimization or of usarrayheightmod, or an npz file")


def hologram_parts(holograms: Holograms) -> Iterator[str]:
    """Yield free space, calibrations and targets of the one-microphone readings."""
    steps = {"step 3": holograms.step3, "step 4": holograms.step4}
    counts = " and ".join(f"{readings.count} of {name}" for name, readings in steps.items())
    yield (
        f"**One microphone**, {counts}. Repeats of a drive scatter by {percent(scatter(holograms.step3))}. "
        "With one free gain:"
    )
    yield table(("free space", *steps, "source strength [Pa m]"), printed(gain_rows(holograms)))
    yield "Calibrated on magnitudes alone, from discs of 4.5 mm and the default prior:"
    header = ("calibrated on", "judged on", "magnitudes", "unseen phases [rad]", "held by 95 % intervals")
    pairs = (steps.items(), reversed(steps.items()))
    yield table(header, printed(calibration_row(*pair) for pair in pairs))
    yield (
        f"Drives for the {3 * TARGETS} targets by {FEW} readings: of the loudest drive of step 3, then of "
        "the one whose prediction is least sure. Deviations from the targets by the calibration of all "
        "readings:"
    )
    yield table(("readings of", "mean", "largest"), printed(target_rows(holograms)))


def scatter(readings: at.Readings) -> float:
    """Return the standard deviation of the repeats of a drive, rms over the rms reading."""
    repeats = readings.pressure.reshape(TRIES, -1)
    return float(repeats.var(dim=0).mean().sqrt() / repeats.square().mean().sqrt())


def gain_rows(holograms: Holograms) -> Iterator[list[str]]:
    """Yield the errors of simulations with one free gain, and the source strength that it means."""
    authors, _ = with_gain(holograms.authors_simulation.repeat(TRIES), holograms.step3)
    yield ["the authors' simulation", percent(authors), "", ""]
    strength = float(scene(RADIUS).array.source_strength)
    for name, radius in (("points", 0.0), ("discs of 4.5 mm", RADIUS), ("discs of 5 mm", AUTHORS_RADIUS)):
        simulated = matrix(radius).T
        pairs = [with_gain((r.drives @ simulated).abs()[:, 0], r) for r in (holograms.step3, holograms.step4)]
        yield [name, *(percent(error) for error, _ in pairs), f"{strength * pairs[0][1]:.3g}"]


def with_gain(magnitudes: torch.Tensor, readings: at.Readings) -> tuple[float, float]:
    """Return the error of magnitudes (N,) with the best gain, and this gain."""
    read = readings.pressure[:, 0]
    gain = (magnitudes @ read) / magnitudes.square().sum()
    return float((gain * magnitudes - read).norm() / read.norm()), float(gain)


def calibrated(readings: at.Readings) -> at.Calibration:
    """Return free space, calibrated by magnitudes alone."""
    magnitudes = replace(readings, phase=None)
    return at.calibrate(at.make_propagator(scene(RADIUS)), magnitudes, folds=0)


def calibration_row(known: tuple[str, at.Readings], other: tuple[str, at.Readings]) -> list[str]:
    """Return the errors of a calibration by readings at others."""
    (name, shown), (judged, unseen) = known, other
    model = calibrated(shown)
    prediction = model.predict(unseen.drives)
    away = prediction.pressure - unseen.pressure
    held = (away.abs() < 1.96 * prediction.of_reading).double().mean()
    assert unseen.phase is not None
    turned = torch.exp(1j * unseen.phase) * (unseen.drives @ model.transfer_matrix.T).conj().sgn()
    phases = (turned * turned.mean().conj()).angle()  # up to the trigger's phase
    error = percent(float(away.norm() / unseen.pressure.norm()))
    return [name, judged, error, f"{float(phases.square().mean().sqrt()):.3f}", percent(float(held))]


def target_rows(holograms: Holograms) -> Iterator[list[str]]:
    """Yield the deviations of predicted drives from their targets, for readings of each repetition."""
    both = holograms.step3, holograms.step4
    pressure, drives = (torch.cat([getattr(r, name) for r in both]) for name in ("pressure", "drives"))
    judge = calibrated(at.Readings(drives, pressure)).transfer_matrix[0]
    for attempt in range(TRIES):
        readings = holograms.step3[attempt * 3 * TARGETS : (attempt + 1) * 3 * TARGETS]
        chosen = informative(readings)
        row = calibrated(readings[chosen]).transfer_matrix[0]
        pairs = zip(readings.drives, *targets(holograms), strict=True)
        wanted = [predicted_drive(row, *each) for each in pairs]
        reached = torch.stack(wanted) @ judge
        off = deviations(reached, *targets(holograms))
        print("readings:", *(f"A{KINDS[n // TARGETS]} {n % TARGETS}" for n in chosen))
        yield [f"repetition {attempt + 1}", percent(float(off.mean())), percent(float(off.max()))]


def targets(holograms: Holograms) -> tuple[torch.Tensor, list[str]]:
    """Return the targets (60,) and their kinds."""
    return holograms.targets, [kind for kind in KINDS for _ in range(TARGETS)]


def informative(readings: at.Readings) -> list[int]:
    """Return the loudest drive and, one by one, those whose predictions are least sure relative to them."""
    chosen = [int(readings.pressure.argmax())]
    while len(chosen) < FEW:
        prediction = calibrated(readings[chosen]).predict(readings.drives)
        unsure = (prediction.deviation / prediction.pressure)[:, 0]
        unsure[chosen] = 0
        chosen.append(int(unsure.argmax()))
    return chosen


def deviations(reached: torch.Tensor, wanted: torch.Tensor, kinds: Sequence[str]) -> torch.Tensor:
    """Return the deviations (60,) of pressures from targets, relative or [rad], up to one common phase."""
    ratio = reached / wanted
    phased = torch.tensor([kind != "ii" for kind in kinds])
    ratio = ratio * ratio[phased].sgn().mean().sgn().conj()
    return torch.stack([deviation(each, kind) for each, kind in zip(ratio, kinds, strict=True)])


def deviation(ratio: torch.Tensor, kind: str) -> torch.Tensor:
    """Return the deviations of pressures from a target, by their ratios to it."""
    return {"i": ratio.sgn() - 1, "ii": ratio.abs() - 1, "iii": ratio - 1}[kind].abs()


def predicted_drive(row: torch.Tensor, start: torch.Tensor, wanted: torch.Tensor, kind: str) -> torch.Tensor:
    """Return the drive (M,) whose pressure by a row (M,) is nearest to a target.

    From a start on, the transducer changes by one phase level that helps most.
    """
    step = torch.exp(torch.tensor(2j * torch.pi / LEVELS.phases))
    changes = torch.stack([step - 1, step.conj() - 1])[:, None]
    drive = start.clone()
    for _ in range(MOVES):
        pressure = row @ drive
        off = deviation((pressure + changes * (row * drive)) / wanted, kind)
        if off.min() >= deviation(pressure / wanted, kind):
            break
        way, transducer = divmod(int(off.argmin()), len(row))
        drive[transducer] *= 1 + changes[way, 0]
    return drive


def scan_parts(scans: Sequence[Scan]) -> Iterator[str]:
    """Yield the likeness of scans and free space."""
    yield (
        "**Scans of a plane.** Correlation with free space at the pixels held back (35 of 36), after a fit "
        "of shift, distance, size, turn and orientation:"
    )
    header = ("scan", "points", "discs of 4.5 mm", "discs of this radius", "wrong emitters, discs of 4.5 mm")
    yield table(header, printed(scan_rows(scans)))


def scan_rows(scans: Sequence[Scan]) -> Iterator[list[str]]:
    """Yield the correlations of each scan, and those with the emitters of the others."""
    for scan in scans:
        points, discs = (scan.correlation(scan.pose(radius)) for radius in (0.0, RADIUS))
        best = scan.pose(RADIUS, fit_radius=True)
        fitted = f"{scan.correlation(best):.3f} ({1e3 * best.radius:.1f} mm)"
        others = [replace(scan, emitters=each.emitters) for each in scans if each is not scan]
        wrong = max(other.correlation(other.pose(RADIUS)) for other in others)
        yield [scan.name, f"{points:.3f}", f"{discs:.3f}", fitted, f"at most {wrong:.2f}"]
