"""Equal foci behind the two cubes by pictures of a camera, or by microphones at the foci.

An array of 16 x 16 plays 16 foci. The measured array differs from the simulated one in gains and phases, and
the obstacle stands 2 mm aside. A camera sees the plane of the foci in steps of half a wavelength, with 2.5 %
of error and a floor in |p|^2. Random drives are read, `calibrate` fits gains, phases and the pose, and
`identify` reads on. Prints medians and quartiles of the true pressures. Takes 2 hours on 2 idle cores.
"""

import contextlib
import dataclasses
import functools
import itertools
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import torch
from shared.document import printed, quartiles, table
from shared.scenes import MIDDLE, paper_scene, with_array

import autdtorch as at
from autdtorch.methods.gradient import random_drives
from autdtorch.propagators import Propagator
from autdtorch.propagators.scene_changes import SceneChanges

GAIN, PHASE = 0.1, 0.5  # rms deviations of the transducers: of the logarithm of the gain, and [rad]
SHIFT = 2e-3  # of the obstacle, in any direction [m]
RELATIVE, FLOOR = 0.025, 0.2  # of the camera: of high pressures, and of the pressure of the foci
MICROPHONE_FLOOR = 0.02
FOCI = 16
REST = 0.05  # of single entries, as a simulation may be off
SIDE, PLACES = 80e-3, 19  # of the seen plane [m], and places along it
CASES = (
    ("pictures", 8, 4),
    ("pictures", 16, 8),
    ("pictures", 32, 12),
    ("microphones", 16, 8),
    ("microphones", 32, 12),
    ("microphones", 64, 24),
)
"""Cases: the sensor, the number of random drives, and that of drives by `identify`."""

OPTIONS = {
    "--trials": {"type": int, "default": 20, "help": "arrays that are measured"},
    "--processes": {"type": int, "default": 1, "help": "that measure arrays side by side"},
    "--noise": {"type": float, "default": 1.0, "help": "factor of the errors of camera and microphones"},
}


def main(trials: int, processes: int, noise: float) -> None:
    header = ["read", "drives", "weakest over optimum", "rms off equal [%]", "largest [%]", "CPU time"]
    print("", table(header, printed(rows(noise, trials, processes))), sep="\n")


class Result(NamedTuple):
    """The true pressures of a drive, in numbers."""

    weakest: float  # focus, over that of the true optimum
    rms: float  # deviation from equal pressures, relative
    largest: float
    seconds: float


def rows(noise: float, trials: int, processes: int) -> Iterator[list[str]]:
    two_cubes()  # processes that are forked have it then
    with ProcessPoolExecutor(processes) if processes > 1 else contextlib.nullcontext() as pool:
        side_by_side = map if pool is None else pool.map
        for case in CASES:
            results = [*side_by_side(functools.partial(trial, case, noise), range(trials))]
            yield [case[0], f"{case[1]} + {case[2]}", *summary(results)]


def trial(case: tuple[str, int, int], noise: float, seed: int) -> Result:
    """Return the pressures of a measured array behind the two cubes."""
    changes = dict.fromkeys((f"obstacles.{axis}" for axis in "xyz"), SHIFT / 3**0.5)
    return measured(two_cubes(), changes, FOCI, *case, seed, noise)


@functools.cache
def two_cubes() -> Propagator:
    array = at.TransducerArray.grid(
        (16, 16), 10e-3, MIDDLE, (1, 0, 0), source_strength=at.PAPER_SOURCE_STRENGTH
    )
    points = torch.cat([grid(4, 60e-3), grid(PLACES, SIDE)])
    scene = dataclasses.replace(with_array(paper_scene("two_cubes"), array), control_points=points)
    return at.make_propagator(scene, "tmatrix", 1.5e-3, tolerance=1e-2)


def summary(results: list[Result]) -> list[str]:
    """Return medians and quartiles of results, as cells."""
    weakest, rms, largest, seconds = torch.tensor(results, dtype=torch.float64).T
    deviations = (quartiles(100 * each, ".1f") for each in (rms, largest))
    return [quartiles(weakest), *deviations, f"{seconds.quantile(0.5):.0f} s"]


def grid(count: int, side: float) -> torch.Tensor:
    """Return centres (count^2, 3) [m] of the cells of a square in the plane of the paper's foci."""
    steps = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * side / count
    return torch.tensor([[80e-3, 50e-3 + y, 50e-3 + z] for y, z in itertools.product(steps, steps)])


class Bench:
    """An array and a scene that both differ from the simulation.

    Attributes:
        amounts: of the changes of the scene.
        log_gain: logarithms of the gains (M,) of the transducers.
        matrix: transfer matrix (P, M) of the bench.
    """

    def __init__(self, propagator: Propagator, changes: Mapping[str, float], seed: int) -> None:
        """Draw the deviations, and compute the matrix of the scene as it is."""
        draws = torch.Generator().manual_seed(seed)
        self.scene, self.evaluations = propagator.scene, 0
        gain, phase = torch.randn(2, len(self.scene.array), dtype=torch.float64, generator=draws)
        direction = torch.randn(len(changes), dtype=torch.float64, generator=draws)
        widths = torch.tensor([*changes.values()], dtype=torch.float64)
        self.amounts = len(changes) ** 0.5 * widths * direction / direction.norm()
        there = SceneChanges(propagator, [*changes]).matrix(self.amounts).to("cpu", torch.complex128)
        self.log_gain = GAIN * gain
        self.matrix = there * torch.polar(self.log_gain.exp(), PHASE * phase)

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (B, M)."""
        self.evaluations += len(drive)
        return (drive @ self.matrix.T).abs()


def measured(
    propagator: Propagator,
    changes: Mapping[str, float],
    foci: int,
    what: str,
    before: int,
    more: int,
    seed: int,
    noise: float = 1.0,
) -> Result:
    """Read random drives, calibrate, identify, and return the true pressures of the solution."""
    if what == "microphones":  # at the foci alone
        scene = propagator.scene
        alone = dataclasses.replace(scene, control_points=scene.control_points[:foci])
        propagator = propagator.for_scene(alone)
    bench = Bench(propagator, changes, seed)
    best = float(at.gradient_ascent(bench.matrix[:foci]).score[0])
    floor = (FLOOR if what == "pictures" else MICROPHONE_FLOOR) * best
    sensor = at.CameraNoise(bench, noise * RELATIVE, noise * floor, seed)
    start = time.process_time()
    drives = random_drives(before, len(propagator.scene.array), torch.Generator().manual_seed(seed))
    pressure = sensor(drives)
    readings = at.Readings(drives, pressure, deviation=sensor.deviation(pressure))
    calibration = at.calibrate(propagator, readings, at.Prior(variants=changes, rest=REST), folds=0)
    goal: at.Goal = at.WeakestFocus()
    if len(bench.matrix) > foci:
        goal = at.SeenPoints(goal, range(foci, len(bench.matrix)))
    prior = calibration.prior_with_readings
    drive = at.identify(sensor, more, prior=prior, readings=readings, goal=goal, seed=seed).drive
    seconds = time.process_time() - start
    true = (drive[0] @ bench.matrix[:foci].T).abs()
    away = true / true.mean() - 1
    return Result(
        float(true.min()) / best, float(away.square().mean().sqrt()), float(away.abs().max()), seconds
    )
