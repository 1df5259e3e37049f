"""How near trials on an emulated device come to the simulation, and how fast; writes docs/hardware.md.

python scripts/benchmark_hardware.py            five to ten minutes
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from generated_block import fill_in, measured, table
from paper_objectives import DOCS, paper_objectives

import autdtorch as at
from autdtorch import hardware
from autdtorch.objectives.perturbations import random_rms
from autdtorch.study.statistics import bootstrap

COMMAND = "python scripts/benchmark_hardware.py"

SCENE = "three_cubes"
DEVICES = (hardware.SONICSURFACE, hardware.OPENMPD)
METHODS = {
    "LSSG": lambda objective, seed: at.lssg(objective),
    "GABS": lambda objective, seed: at.gabs(objective, seed=seed),
    "GABS, 3 passes": lambda objective, seed: at.gabs(objective, passes=3, seed=seed),
    "identify": lambda objective, seed: at.identify(objective, seed=seed),
}
SEEDS = range(10)
SNR = 30.0  # dB

_CHIP = (0x2A8D, 0x1770)
_SENSITIVITY = 0.01  # V/Pa
_LOUDEST = 20.0  # Pa

Method = Callable[[at.Objective], at.Solution]
Sensor = Callable[[hardware.EmulatedBench, at.Scene, int], contextlib.AbstractContextManager[hardware.Sensor]]


class Trial(NamedTuple):
    """A trial on an emulated device: what was found, how long it took, and how long it would wait there."""

    found: at.Solution
    seconds: float
    waits: float


@contextlib.contextmanager
def readings(
    bench: hardware.EmulatedBench, scene: at.Scene, seed: int, snr: float | None = SNR
) -> Iterator[hardware.Sensor]:
    """Readings with noise."""
    yield hardware.EmulatedSensor(bench, snr, seed)


@contextlib.contextmanager
def oscilloscope(bench: hardware.EmulatedBench, scene: at.Scene, seed: int) -> Iterator[hardware.ScopeSensor]:
    """Microphones at an oscilloscope: noise in each of its samples, an offset, 8 bits, and slow drift."""
    rms = _SENSITIVITY * random_rms(bench.transfer_matrix)
    inputs = range(len(scene.control_points))
    emulated = hardware.EmulatedScope(
        bench.pressure,
        scene.frequency,
        _SENSITIVITY,
        inputs,
        noise=rms * 10 ** (-SNR / 20),
        dc_offset=0.1 * rms,
        drift=0.01,
        seed=seed,
    )
    emulated.plug_into(bench, _CHIP)
    microphones = [hardware.Microphone(number + 1, _SENSITIVITY, _LOUDEST) for number in inputs]
    with hardware.open_scope(_CHIP, backend=bench.bus) as scope:
        yield hardware.ScopeSensor(scope, scene.frequency, microphones)


noiseless = partial(readings, snr=None)


def measure(
    simulated: at.SimulatedObjective, device: hardware.Device, sensor: Sensor, method: Method, seed: int
) -> Trial:
    """Run the whole loop, log on disk included."""
    transducers = range(len(simulated.scene.array))
    bench = hardware.EmulatedBench(device, simulated.transfer_matrix, transducers)
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        sensor(bench, simulated.scene, seed) as opened,
        hardware.open_link(device, transducers, backend=bench.bus) as link,
    ):
        limited = hardware.LimitedLink(link, hardware.Limits(amplitude=1.0))
        log = Path(folder) / "trial.jsonl"
        objective = hardware.HardwareObjective(simulated.scene, limited, opened, log)
        begin, slept = time.perf_counter(), bench.bus.slept
        found = method(objective)
        return Trial(found, time.perf_counter() - begin, bench.bus.slept - slept)


def same_drives(simulated: at.SimulatedObjective, device: hardware.Device, name: str) -> list[str]:
    """A row of the table of trials without noise."""
    same, foci = 0, []
    for seed in SEEDS:
        method = partial(METHODS[name], seed=seed)
        expected = method(hardware.Played(simulated, device, range(len(simulated.scene.array))))
        foci.append(float(expected.pressure.min()))
        found = measure(simulated, device, noiseless, method, seed).found
        same += torch.allclose(found.drive, expected.drive, rtol=0, atol=1e-9)
    return [device.name, name, f"{min(foci):.2f} to {max(foci):.2f}", f"{same} of {len(SEEDS)}"]


def with_noise(
    simulated: at.SimulatedObjective, device: hardware.Device, sensor: Sensor, name: str
) -> list[str]:
    """A row of the table of what noise costs."""
    on_levels = hardware.Played(simulated, device, range(len(simulated.scene.array)))
    deviations = []
    for seed in SEEDS:
        method = partial(METHODS[name], seed=seed)
        found = measure(simulated, device, sensor, method, seed).found
        truly = at.weakest_focus(at.true_pressure(on_levels, found.drive))
        deviations.append(float(truly / at.weakest_focus(method(on_levels).pressure)) - 1)
    mean = bootstrap(torch.tensor(deviations))
    percent = [f"{100 * value:+.1f}" for value in (mean.value, mean.low, mean.high)]
    return [
        device.name,
        name,
        f"{percent[0]} ({percent[1]} to {percent[2]})",
        f"{100 * min(deviations):+.1f} to {100 * max(deviations):+.1f}",
        f"{sum(abs(deviation) <= 0.05 for deviation in deviations)} of {len(SEEDS)}",
    ]


def rate(simulated: at.SimulatedObjective, device: hardware.Device) -> list[str]:
    """A row of the table of rates: GABS, the median of its trials."""
    trials = [
        measure(simulated, device, noiseless, partial(METHODS["GABS"], seed=seed), seed) for seed in SEEDS
    ]
    count = int(trials[0].found.evaluations)
    seconds = float(torch.tensor([trial.seconds for trial in trials]).median())
    frame = device.frame(torch.zeros(device.transducers, dtype=torch.complex128))
    wire = device.wire_time(frame)
    return [
        device.name,
        f"{count / seconds:.0f}",
        f"{1 / wire:.0f}" if wire else "-",
        f"{count / (seconds + trials[0].waits):.0f}",
    ]


def main() -> None:
    """Measure, and write the block."""
    simulated = paper_objectives()[SCENE]
    same = [same_drives(simulated, device, name) for device in DEVICES for name in METHODS]
    noisy = [
        [where, *with_noise(simulated, device, sensor, name)]
        for where, sensor, devices in (
            ("readings", readings, DEVICES),
            ("samples of an oscilloscope", oscilloscope, DEVICES[:1]),
        )
        for device in devices
        for name in METHODS
    ]
    rates = [rate(simulated, device) for device in DEVICES]
    parts = (
        measured(COMMAND),
        f"The scene `{SCENE}` on emulated devices, {len(SEEDS)} seeds. Simulated: the weakest focus of the\n"
        "trials in the simulation. Without noise: trials on the emulated device that find the same drive.",
        table(["device", "method", "simulated [Pa]", "same drive without noise"], same),
        f"With noise {SNR:g} dB below the rms pressure of random drives, in every reading or in every\n"
        "sample of an oscilloscope, which has 8 bits, an offset and slow drift, and `loudest` at\n"
        f"{_LOUDEST:g} Pa: the weakest focus that the drive found truly makes, against the simulated\n"
        "trial of the same seed; mean with its 95 % interval, range, and trials within 5 %.",
        table(["noise in", "device", "method", "mean [%]", "range [%]", "within 5 %"], noisy),
        "Evaluations per second of GABS: as the emulated loop runs, with its log on disk and without\n"
        "waiting; frames per second on the serial line; and evaluations per second with all that a bench\n"
        "would wait for: frames on the line, the off frames between calls, and 5 ms for the sound to stand.\n"
        "A sensor's own time comes on top.",
        table(["device", "emulated loop", "line", "with waits"], rates),
    )
    fill_in(DOCS / "hardware.md", "benchmark_hardware", parts, DOCS)


if __name__ == "__main__":
    main()
