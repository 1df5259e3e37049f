"""How near trials on an emulated device come to the simulation, and how fast; writes docs/hardware.md.

python scripts/benchmark_hardware.py            two to four minutes
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from generated_block import fill_in, measured, table
from paper_objectives import DOCS, paper_objectives

import autdtorch as at
from autdtorch import hardware
from autdtorch.intervals import bootstrap

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

Method = Callable[[at.Objective], at.Solution]


class Trial(NamedTuple):
    """A trial on an emulated device: what was found, how long it took, and how long it would wait there."""

    found: at.Solution
    seconds: float
    waits: float


def measure(
    simulated: at.SimulatedObjective, device: hardware.Device, method: Method, snr: float | None, seed: int
) -> Trial:
    """Run the whole loop, log on disk included."""
    transducers = range(len(simulated.scene.array))
    bench = hardware.EmulatedBench(device, simulated.transfer_matrix, transducers)
    sensor = hardware.EmulatedSensor(bench, snr, seed)
    with (
        tempfile.TemporaryDirectory() as folder,
        hardware.open_link(device, transducers, backend=bench.bus) as link,
    ):
        limited = hardware.LimitedLink(link, hardware.Limits(amplitude=1.0))
        log = Path(folder) / "trial.jsonl"
        objective = hardware.HardwareObjective(simulated.scene, limited, sensor, log)
        begin, slept = time.perf_counter(), bench.bus.slept
        found = method(at.Quantised(objective, **device.quantised))
        return Trial(found, time.perf_counter() - begin, bench.bus.slept - slept)


def compare(simulated: at.SimulatedObjective, device: hardware.Device, name: str) -> list[str]:
    """A row of the table: the same drives without noise, and what noise costs."""
    on_levels = at.Quantised(simulated, **device.quantised)
    same, deviations, simulated_foci = 0, [], []
    for seed in SEEDS:
        method = partial(METHODS[name], seed=seed)
        expected = method(on_levels)
        simulated_foci.append(float(expected.pressure.min()))
        silent = measure(simulated, device, method, None, seed).found
        same += torch.allclose(silent.drive, expected.drive, rtol=0, atol=1e-9)
        found = measure(simulated, device, method, SNR, seed).found
        truly = at.weakest_focus(at.true_pressure(on_levels, found.drive))
        deviations.append(float(truly / at.weakest_focus(expected.pressure)) - 1)
    mean = bootstrap(torch.tensor(deviations))
    percent = [f"{100 * value:+.1f}" for value in (mean.value, mean.low, mean.high)]
    within = sum(abs(deviation) <= 0.05 for deviation in deviations)
    return [
        device.name,
        name,
        f"{min(simulated_foci):.2f} to {max(simulated_foci):.2f}",
        f"{same} of {len(SEEDS)}",
        f"{percent[0]} ({percent[1]} to {percent[2]})",
        f"{100 * min(deviations):+.1f} to {100 * max(deviations):+.1f}",
        f"{within} of {len(SEEDS)}",
    ]


def rate(simulated: at.SimulatedObjective, device: hardware.Device) -> list[str]:
    """A row of the table of rates: GABS, the median of its trials."""
    trials = [measure(simulated, device, partial(METHODS["GABS"], seed=seed), None, seed) for seed in SEEDS]
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
    rows = [compare(simulated, device, name) for device in DEVICES for name in METHODS]
    rates = [rate(simulated, device) for device in DEVICES]
    parts = (
        measured(COMMAND),
        f"The scene `{SCENE}` on emulated devices, {len(SEEDS)} seeds. Simulated: the weakest focus of the\n"
        "trials in the simulation. Without noise: trials on the emulated device that find the same drive.\n"
        f"With microphones of {SNR:g} dB: the weakest focus that the drive found truly makes, against the\n"
        "simulated trial of the same seed; mean with its 95 % interval, range, and trials within 5 %.",
        table(
            [
                *("device", "method", "simulated [Pa]", "same drive"),
                *(f"at {SNR:g} dB: mean [%]", "range [%]", "within 5 %"),
            ],
            rows,
        ),
        "Evaluations per second of GABS: as the emulated loop runs, with its log on disk and without\n"
        "waiting; frames per second on the serial line; and evaluations per second with all that a bench\n"
        "would wait for: frames on the line, the off frames between calls, and 5 ms for the sound to stand.\n"
        "A sensor's own time comes on top.",
        table(["device", "emulated loop", "line", "with waits"], rates),
    )
    fill_in(DOCS / "hardware.md", "benchmark_hardware", parts, DOCS)


if __name__ == "__main__":
    main()
