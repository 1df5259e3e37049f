"""Calibration of simulated benches by old readings: the drive that it gives, gains, phases and the pose.

An AUTD3 of discs behind the paper's two cubes and behind a tilted phone. The bench differs in gains, phases,
the obstacle's pose and the temperature, and its readings have noise. Takes about 20 minutes on 2 idle cores.
"""

import dataclasses
import math
import time
from collections.abc import Iterator

import torch
from shared.document import Page, table
from shared.scenes import autd3_array, paper_scene, with_array

import autdtorch as at
from autdtorch.propagators.scene_changes import SceneChanges

DOCUMENT = "measured.md"
GAIN, PHASE = 0.1, 0.5  # rms of the logarithm of the gain, and [rad]
SHIFT, TURN = 2e-3, math.radians(2)  # of the obstacle, about any axis
WARMER = 5.0  # K
NOISE = 30.0  # dB below the rms pressure of random phases
OUTLIER = 100.0  # factor of a false reading

OPTIONS = {
    "--scenes": {"default": "two_cubes,phone", "help": "scenes, by commas"},
    "--seeds": {"type": int, "default": 20, "help": "benches"},
    "--readings": {"type": int, "default": 64, "help": "drives of random phases that were read"},
    "--outliers": {"type": float, "default": 0.0, "help": "share of readings a hundred times too large"},
}

_POSE = (
    "obstacles.x",
    "obstacles.y",
    "obstacles.z",
    "obstacles.turn_x",
    "obstacles.turn_y",
    "obstacles.turn_z",
)
_PRIOR = {
    **dict.fromkeys(_POSE[:3], SHIFT / 3**0.5),
    **dict.fromkeys(_POSE[3:], TURN / 3**0.5),
    "temperature": WARMER,
}


def main(page: Page, scenes: str, seeds: int, readings: int, outliers: float) -> None:
    """Measure and write the block."""
    header = [
        "scene", "drives", "outliers", "share of the optimum", "before", "gains within 2 deviations",
        "place off", "stated", "time",
    ]  # fmt: skip
    rows = [row for name in scenes.split(",") for row in _rows(name, seeds, readings, outliers)]
    page.add(table(header, rows))


def scene_of(name: str) -> at.Scene:
    """Return a scene by its name: "two_cubes", or "phone"."""
    cubes = with_array(paper_scene("two_cubes"), autd3_array())
    if name == "two_cubes":
        return cubes
    x, y, z = cubes.array.positions.mean(dim=0).tolist()
    phone = at.Box((x + 0.08, y, z), (0.15, 0.075, 0.008), rigid=True, rotation=(0.0, 1.2, 0.0))
    behind = torch.tensor([[x + 0.13, y + dy, z + dz] for dy in (-0.02, 0.02) for dz in (-0.02, 0.02)])
    lower, upper = (x - 0.01, y - 0.1, z - 0.1), (x + 0.16, y + 0.1, z + 0.1)
    return dataclasses.replace(
        cubes, name="phone", obstacles=(phone,), control_points=behind, domain=(lower, upper)
    )


def _rows(name: str, seeds: int, readings: int, outliers: float) -> Iterator[list[str]]:
    propagator = at.make_propagator(scene_of(name), method="tmatrix" if name == "two_cubes" else "auto")
    results = []
    for seed in range(seeds):
        results.append(_calibrated(propagator, seed, readings, outliers))
        print(name, seed, [round(value, 4) for value in results[-1]], flush=True)
    share, before, within, off, stated, seconds = torch.tensor(results).quantile(0.5, dim=0).tolist()
    yield [
        name, str(readings), f"{outliers:.0%}", f"{share:.3f}", f"{before:.3f}", f"{within:.0%}",
        f"{1e3 * off:.2f} mm", f"{1e3 * stated:.2f} mm", f"{seconds:.0f} s",
    ]  # fmt: skip


def _calibrated(
    propagator: at.propagators.Propagator, seed: int, count: int, outliers: float
) -> tuple[float, float, float, float, float, float]:
    """Return shares of the optimum after and before, share of gains, the pose's error and deviation, time."""
    draws = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=draws)

    changes = SceneChanges(propagator, [*_PRIOR])
    shift, turn = normal(2, 3)
    amounts = torch.cat([SHIFT * shift / shift.norm(), TURN * turn / turn.norm(), WARMER * normal(1)])
    simulated = changes.matrix(torch.zeros_like(amounts))
    log_gain, phase = GAIN * normal(simulated.shape[1]), PHASE * normal(simulated.shape[1])
    matrix = changes.matrix(amounts) * torch.polar(log_gain.exp(), phase)
    phases = 2 * math.pi * torch.rand(count, len(phase), dtype=torch.float64, generator=draws)
    drives = at.drive_from_phases(phases)
    pressure = drives @ matrix.T
    noise = 10 ** (-NOISE / 20) * float(pressure.abs().square().mean().sqrt())
    pressure = (
        pressure + noise * torch.complex(normal(*pressure.shape), normal(*pressure.shape)) / 2**0.5
    ).abs()
    false = torch.rand(pressure.shape, generator=draws) < outliers
    readings = at.Readings(drives, torch.where(false, OUTLIER * pressure, pressure))
    begin = time.perf_counter()
    model = at.calibrate(
        propagator, readings, at.Prior(variants=_PRIOR, gain=GAIN, phase=PHASE, rest=0.02), folds=0
    )
    drive = at.gradient_ascent(model.transfer_matrix).drive
    seconds = time.perf_counter() - begin

    def weakest(drive: torch.Tensor) -> float:
        return float((drive @ matrix.T).abs().amin())

    best = weakest(at.gradient_ascent(matrix).drive)
    deviates = (model.gain.log() - log_gain) / model.gain_deviation
    place = [model.amounts[name] for name in _POSE[:3]]
    off = math.dist([value for value, _ in place], amounts[:3].tolist())
    stated = math.hypot(*(deviation for _, deviation in place))
    before = weakest(at.gradient_ascent(simulated).drive)
    within = float((deviates.abs() < 2).double().mean())
    return weakest(drive) / best, before / best, within, off, stated, seconds
