"""Calibration of simulated benches by old readings: the drive that it gives, gains, phases and the pose.

An AUTD3 of discs behind the paper's two cubes. The bench differs in gains, phases, the obstacle's pose and
the temperature, and its readings of random drives have noise.
"""

import math
import time
from collections.abc import Iterator

import torch
from benchmarks.pictures import GAIN, PHASE, SHIFT, Bench
from shared.document import printed, table
from shared.scenes import autd3_array, paper_scene, weakest, with_array

import autdtorch as at
from autdtorch.methods.gradient import random_drives
from autdtorch.objectives.perturbations import random_rms

NOISE = 30.0  # dB below the rms pressure of random phases
DRIVES = 128  # that were read
PLACE = tuple(f"obstacles.{axis}" for axis in "xyz")
CHANGES = {
    **dict.fromkeys(PLACE, SHIFT / 3**0.5),
    **dict.fromkeys((f"obstacles.turn_{axis}" for axis in "xyz"), math.radians(2) / 3**0.5),
    "temperature": 5.0,
}

OPTIONS = {"--seeds": {"type": int, "default": 5, "help": "benches"}}


def main(seeds: int) -> None:
    scene = with_array(paper_scene("two_cubes"), autd3_array())
    propagator = at.make_propagator(scene, method="tmatrix")
    header = ["bench", "of the optimum", "before", "gains within 2 deviations", "off", "stated", "time"]
    print("", table(header, printed(rows(propagator, seeds))), sep="\n")


def rows(propagator: at.propagators.Propagator, seeds: int) -> Iterator[list[str]]:
    results = []
    for seed in range(seeds):
        results.append(calibrated(propagator, seed))
        yield row(str(seed), *results[-1])
    yield row("median", *torch.tensor(results).quantile(0.5, dim=0).tolist())


def row(
    name: str, share: float, before: float, within: float, off: float, stated: float, seconds: float
) -> list[str]:
    lengths = (f"{1e3 * length:.2f} mm" for length in (off, stated))
    return [name, f"{share:.3f}", f"{before:.3f}", f"{within:.0%}", *lengths, f"{seconds:.0f} s"]


def calibrated(propagator: at.propagators.Propagator, seed: int) -> tuple[float, ...]:
    """Return shares of the optimum after and before, share of gains, the pose's error and deviation, time."""
    bench = Bench(propagator, CHANGES, seed)
    drives = random_drives(DRIVES, len(propagator.scene.array), torch.Generator().manual_seed(1000 + seed))
    sensor = at.Noise(bench, NOISE, seed=seed, reference=random_rms(bench.matrix))
    readings = at.Readings(drives, sensor(drives))
    begin = time.perf_counter()
    model = at.calibrate(
        propagator, readings, at.Prior(variants=CHANGES, gain=GAIN, phase=PHASE, rest=0.02), folds=0
    )
    drive = at.gradient_ascent(model.transfer_matrix).drive[0]
    seconds = time.perf_counter() - begin
    best, after, before = (
        float(weakest(bench.matrix, each))
        for each in (
            at.gradient_ascent(bench.matrix).drive[0],
            drive,
            at.gradient_ascent(propagator.transfer_matrix()).drive[0],
        )
    )
    within = float(((model.gain.log() - bench.log_gain) / model.gain_deviation).abs().lt(2).double().mean())
    place = [model.amounts[name] for name in PLACE]
    off = math.dist([value for value, _ in place], bench.amounts[:3].tolist())
    stated = math.hypot(*(deviation for _, deviation in place))
    return after / best, before / best, within, off, stated, seconds
