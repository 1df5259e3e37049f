"""Hardware trials on emulated devices with noise.

Takes five to ten minutes.
"""

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import torch
from shared.document import Page, table
from shared.scenes import paper_objectives

import autdtorch as at
from autdtorch import hardware
from autdtorch.objectives.perturbations import random_rms
from autdtorch.study.statistics import bootstrap

DOCUMENT = "hardware.md"

SCENE = "three_cubes"
DEVICE = hardware.SONICSURFACE
METHODS = {
    "LSSG": lambda objective, seed: at.lssg(objective),
    "GABS": at.gabs,
    "GABS, 3 passes": partial(at.gabs, passes=3),
    "identify": at.identify,
}
SNR = 30.0  # dB

_CHIP = (0x2A8D, 0x1770)
_SENSITIVITY = 0.01  # V/Pa
_LOUDEST = 20.0  # Pa

Method = Callable[..., at.Solution]
"""A method of an objective and a `seed`."""
Sensor = Callable[[hardware.EmulatedBench, at.Scene, int], contextlib.AbstractContextManager[hardware.Sensor]]


OPTIONS = {"--seeds": {"type": int, "default": 10, "help": "trials of each kind"}}


def main(page: Page, seeds: int) -> None:
    """Measure, and write the block."""
    simulated, seeds = paper_objectives()[SCENE], range(seeds)
    noisy = [
        [where, name, *with_noise(simulated, sensor, method, seeds)]
        for where, sensor in (("readings", readings), ("samples", oscilloscope))
        for name, method in METHODS.items()
    ]
    page.write(
        f"The scene `{SCENE}` on an emulated {DEVICE.name}, {len(seeds)} seeds. Noise {SNR:g} dB below the\n"
        "rms pressure of random drives is in every reading, or in every sample of an oscilloscope: true\n"
        "weakest focus against the simulated trial of the same seed.",
        table(["noise in", "method", "mean (95 % interval) [%]", "range [%]", "within 5 %"], noisy),
    )


@contextlib.contextmanager
def readings(bench: hardware.EmulatedBench, scene: at.Scene, seed: int) -> Iterator[hardware.Sensor]:
    """Yield a sensor whose readings have noise."""
    yield hardware.EmulatedSensor(bench, SNR, seed)


@contextlib.contextmanager
def oscilloscope(bench: hardware.EmulatedBench, scene: at.Scene, seed: int) -> Iterator[hardware.ScopeSensor]:
    """Yield microphones at an oscilloscope: noise in each sample, an offset, 8 bits, and slow drift."""
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


def measure(simulated: at.SimulatedObjective, sensor: Sensor, method: Method, seed: int) -> at.Solution:
    """Run the whole loop, with its log on disk."""
    transducers = range(len(simulated.scene.array))
    bench = hardware.EmulatedBench(DEVICE, simulated.transfer_matrix, transducers)
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        sensor(bench, simulated.scene, seed) as opened,
        hardware.open_link(DEVICE, transducers, backend=bench.bus) as link,
    ):
        limited = hardware.LimitedLink(link, hardware.Limits(amplitude=1.0))
        log = Path(folder) / "trial.jsonl"
        objective = hardware.HardwareObjective(simulated.scene, limited, opened, log)
        return method(objective, seed=seed)


def with_noise(simulated: at.SimulatedObjective, sensor: Sensor, method: Method, seeds: range) -> list[str]:
    """Return the cells of a method in the table of noise."""
    played = hardware.Played(simulated, DEVICE, range(len(simulated.scene.array)))
    deviations = []
    for seed in seeds:
        drive = measure(simulated, sensor, method, seed).drive
        true = at.weakest_focus(at.true_pressure(played, drive))
        deviations.append(float(true / at.weakest_focus(method(played, seed=seed).pressure)) - 1)
    mean = bootstrap(torch.tensor(deviations))
    percent = [f"{100 * value:+.1f}" for value in (mean.value, mean.low, mean.high)]
    within = sum(abs(deviation) <= 0.05 for deviation in deviations)
    return [
        f"{percent[0]} ({percent[1]} to {percent[2]})",
        f"{100 * min(deviations):+.1f} to {100 * max(deviations):+.1f}",
        f"{within} of {len(seeds)}",
    ]
