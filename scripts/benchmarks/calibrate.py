"""Calibration of simulated benches by old readings: the drive that it gives, gains, phases and the pose.

An AUTD3 of discs behind the paper's two cubes. The bench differs in gains, phases, the obstacle's pose and
the temperature, and its readings of random drives have noise.
"""

import math
import time
from collections.abc import Iterator, Sequence

import torch
from shared.document import printed, table
from shared.scenes import autd3_array, paper_scene, with_array

import autdtorch as at
from autdtorch.propagators.scene_changes import SceneChanges

GAIN, PHASE = 0.1, 0.5  # rms of the logarithm of the gain, and [rad]
SHIFT, TURN = 2e-3, math.radians(2)  # of the obstacle, about any axis
WARMER = 5.0  # K
NOISE = 30.0  # dB below the rms pressure of random phases
DRIVES = 128  # of random phases, that were read

OPTIONS = {"--seeds": {"type": int, "default": 5, "help": "benches"}}

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


def main(seeds: int) -> None:
    """Measure benches, and print each and the medians."""
    scene = with_array(paper_scene("two_cubes"), autd3_array())
    propagator = at.make_propagator(scene, method="tmatrix")
    header = [
        "bench",
        "of the optimum",
        "before",
        "gains within 2 deviations",
        "place off",
        "as stated",
        "time",
    ]
    results = []

    def rows() -> Iterator[list[str]]:
        for seed in range(seeds):
            results.append(calibrated(propagator, seed))
            yield row(str(seed), results[-1])
        yield row("median", torch.tensor(results).quantile(0.5, dim=0).tolist())

    print("", table(header, printed(rows())), sep="\n")


def row(name: str, result: Sequence[float]) -> list[str]:
    """Return the results of a bench as cells."""
    share, before, within, off, stated, seconds = result
    lengths = (f"{1e3 * length:.2f} mm" for length in (off, stated))
    return [name, f"{share:.3f}", f"{before:.3f}", f"{within:.0%}", *lengths, f"{seconds:.0f} s"]


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

    def readings(self) -> at.Readings:
        """Return readings of random drives."""
        shape = (DRIVES, self.matrix.shape[1])
        phases = 2 * math.pi * torch.rand(shape, dtype=torch.float64, generator=self.draws)
        drives = at.drive_from_phases(phases)
        return at.Readings(drives, self(drives))

    def weakest(self, drive: torch.Tensor) -> float:
        """Return the weakest focus [Pa] of a drive (1, M), without noise."""
        return float((drive @ self.matrix.T).abs().amin())

    def _normal(self, *shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=self.draws)


def calibrated(
    propagator: at.propagators.Propagator, seed: int
) -> tuple[float, float, float, float, float, float]:
    """Return shares of the optimum after and before, share of gains, the pose's error and deviation, time."""
    bench = Bench(propagator, seed)
    readings = bench.readings()
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
