"""Calibration of simulated benches by old readings: the drive that it gives, gains, phases and the pose.

An AUTD3 of discs behind the paper's two cubes and behind a tilted phone. The bench differs in gains, phases,
the obstacle's pose and the temperature, and its readings have noise. Takes about 20 minutes on 2 idle cores.
"""

import dataclasses
import math
import time

import torch
from shared.document import printed
from shared.scenes import autd3_array, paper_scene, with_array

import autdtorch as at
from autdtorch.propagators.scene_changes import SceneChanges

GAIN, PHASE = 0.1, 0.5  # rms of the logarithm of the gain, and [rad]
SHIFT, TURN = 2e-3, math.radians(2)  # of the obstacle, about any axis
WARMER = 5.0  # K
NOISE = 30.0  # dB below the rms pressure of random phases
OUTLIER = 100.0  # factor of a false reading

OPTIONS = {
    "--scenes": {"default": "two_cubes,phone", "help": "scenes, by commas"},
    "--drives": {
        "default": "64 random,128 random,64 trial",
        "help": "drives that were read: of random phases, or those of a trial of identify",
    },
    "--seeds": {"type": int, "default": 20, "help": "benches"},
    "--outliers": {"default": "0,0.02", "help": "shares of readings a hundred times too large"},
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


def main(scenes: str, drives: str, seeds: int, outliers: str) -> None:
    """Measure, and print medians.

    Of each case: share of the optimum, and before; gains within 2 deviations; place off, and as stated; time.
    """
    printed(
        _row(propagator, kind, seeds, float(share))
        for propagator in map(_propagator, scenes.split(","))
        for kind in drives.split(",")
        for share in outliers.split(",")
    )


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


def _propagator(name: str) -> at.propagators.Propagator:
    return at.make_propagator(scene_of(name), method="tmatrix" if name == "two_cubes" else "auto")


def _row(propagator: at.propagators.Propagator, drives: str, seeds: int, outliers: float) -> list[str]:
    count, kind = drives.split()
    results = []
    for seed in range(seeds):
        results.append(_calibrated(propagator, kind, seed, int(count), outliers))
        print(
            propagator.scene.name,
            kind,
            outliers,
            seed,
            [round(value, 4) for value in results[-1]],
            flush=True,
        )
    share, before, within, off, stated, seconds = torch.tensor(results).quantile(0.5, dim=0).tolist()
    false = f", {outliers:.0%} outliers" if outliers else ""
    return [
        f"{propagator.scene.name}, {count} {kind}{false}", f"{share:.3f}", f"{before:.3f}",
        f"{within:.0%}", f"{1e3 * off:.2f} mm", f"{1e3 * stated:.2f} mm", f"{seconds:.0f} s",
    ]  # fmt: skip


class Bench:
    """An array, an obstacle and air that differ from the simulation, and a noisy microphone."""

    def __init__(self, propagator: at.propagators.Propagator, seed: int) -> None:
        """Draw the deviations, and simulate the scene as it is."""
        self.draws = torch.Generator().manual_seed(seed)
        changes = SceneChanges(propagator, [*_PRIOR])
        shift, turn = self._normal(2, 3)
        parts = [SHIFT * shift / shift.norm(), TURN * turn / turn.norm(), WARMER * self._normal(1)]
        self.amounts = torch.cat(parts)
        self.simulated = changes.matrix(torch.zeros_like(self.amounts))
        count = self.simulated.shape[1]
        self.log_gain, phase = GAIN * self._normal(count), PHASE * self._normal(count)
        self.matrix = changes.matrix(self.amounts) * torch.polar(self.log_gain.exp(), phase)
        self._noise = 10 ** (-NOISE / 20) * float(self.matrix.abs().square().sum(dim=1).mean().sqrt())

    def __call__(self, drives: torch.Tensor) -> torch.Tensor:
        """Read magnitudes of drives (N, M)."""
        pressure = drives @ self.matrix.T
        noise = torch.complex(self._normal(*pressure.shape), self._normal(*pressure.shape))
        return (pressure + 0.5**0.5 * self._noise * noise).abs()

    def readings(self, kind: str, count: int, outliers: float, seed: int) -> at.Readings:
        """Return readings of random drives, or of those that `identify` asked for in a trial."""
        if kind == "random":
            shape = (count, self.matrix.shape[1])
            phases = 2 * math.pi * torch.rand(shape, dtype=torch.float64, generator=self.draws)
            drives = at.drive_from_phases(phases)
            pressure = self(drives)
        else:
            method = at.Identify(count, at.Prior(self.simulated))
            points, transducers = self.matrix.shape
            state = method.start(at.Problem(transducers, points), seed)
            parts = []
            while not state.done:
                asked = method.ask(state)
                parts.append((asked, self(asked)))
                state = method.tell(state, parts[-1][1])
            drives, pressure = (torch.cat(part) for part in zip(*parts, strict=True))
        false = torch.rand(pressure.shape, generator=self.draws) < outliers
        return at.Readings(drives, torch.where(false, OUTLIER * pressure, pressure))

    def weakest(self, drive: torch.Tensor) -> float:
        """Return the weakest focus [Pa] of a drive (1, M), without noise."""
        return float((drive @ self.matrix.T).abs().amin())

    def _normal(self, *shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=self.draws)


def _calibrated(
    propagator: at.propagators.Propagator, kind: str, seed: int, count: int, outliers: float
) -> tuple[float, float, float, float, float, float]:
    """Return shares of the optimum after and before, share of gains, the pose's error and deviation, time."""
    bench = Bench(propagator, seed)
    readings = bench.readings(kind, count, outliers, seed)
    prior = at.Prior(variants=_PRIOR, gain=GAIN, phase=PHASE, rest=0.02)
    begin = time.perf_counter()
    model = at.calibrate(propagator, readings, prior, folds=0)
    drive = at.gradient_ascent(model.transfer_matrix).drive
    seconds = time.perf_counter() - begin
    best = bench.weakest(at.gradient_ascent(bench.matrix).drive)
    before = bench.weakest(at.gradient_ascent(bench.simulated).drive)
    within = float(((model.gain.log() - bench.log_gain) / model.gain_deviation).abs().lt(2).double().mean())
    place = [model.amounts[name] for name in _POSE[:3]]
    off = math.dist([value for value, _ in place], bench.amounts[:3].tolist())
    stated = math.hypot(*(deviation for _, deviation in place))
    return bench.weakest(drive) / best, before / best, within, off, stated, seconds
