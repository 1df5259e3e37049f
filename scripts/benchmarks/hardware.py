"""Hardware trials on emulated devices with noise.

Takes five to ten minutes.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from shared.document import Page, table
from shared.scenes import paper_objectives

import autdtorch as at
from autdtorch import hardware
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

Method = Callable[..., at.Solution]
"""A method of an objective and a `seed`."""


OPTIONS = {"--seeds": {"type": int, "default": 10, "help": "trials of each kind"}}


def main(page: Page, seeds: int) -> None:
    """Measure, and write the block."""
    simulated, seeds = paper_objectives()[SCENE], range(seeds)
    noisy = [[name, *with_noise(simulated, method, seeds)] for name, method in METHODS.items()]
    page.write(
        f"The scene `{SCENE}` on an emulated {DEVICE.name}, {len(seeds)} seeds. Noise {SNR:g} dB below the\n"
        "rms pressure of random drives is in every reading: true\n"
        "weakest focus against the simulated trial of the same seed.",
        table(["method", "mean (95 % interval) [%]", "within 5 %"], noisy),
    )


def measure(simulated: at.SimulatedObjective, method: Method, seed: int) -> at.Solution:
    """Run the whole loop, with its log on disk."""
    transducers = range(len(simulated.scene.array))
    bench = hardware.EmulatedBench(DEVICE, simulated.transfer_matrix, transducers)
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        hardware.open_link(DEVICE, transducers, backend=bench.bus) as link,
    ):
        sensor = hardware.EmulatedSensor(bench, SNR, seed)
        limited = hardware.LimitedLink(link, hardware.Limits(amplitude=1.0))
        log = Path(folder) / "trial.jsonl"
        objective = hardware.HardwareObjective(simulated.scene, limited, sensor, log)
        return method(objective, seed=seed)


def with_noise(simulated: at.SimulatedObjective, method: Method, seeds: range) -> list[str]:
    """Return the cells of a method in the table of noise."""
    played = hardware.Played(simulated, DEVICE, range(len(simulated.scene.array)))
    deviations = []
    for seed in seeds:
        drive = measure(simulated, method, seed).drive
        true = at.weakest_focus(at.true_pressure(played, drive))
        deviations.append(float(true / at.weakest_focus(method(played, seed=seed).pressure)) - 1)
    mean = bootstrap(torch.tensor(deviations))
    percent = [f"{100 * value:+.1f}" for value in (mean.value, mean.low, mean.high)]
    within = sum(abs(deviation) <= 0.05 for deviation in deviations)
    return [
        f"{percent[0]} ({percent[1]} to {percent[2]})",
        f"{within} of {len(seeds)}",
    ]
