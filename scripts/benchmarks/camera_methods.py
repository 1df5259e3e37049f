"""Methods in the paper's scenes by the pictures of a thermal camera, against microphones at the foci.

Every drive is a pulse of an emulated SonicSurface in front of an emulated camera, which writes its frames to
files. The array is strong enough for it. Microphones have no noise, and a method's random choices are the
same with both. Prints the true weakest focus of the drives that the methods choose. The logs of the trials
stay in a folder, and another run goes on from them.
"""

import contextlib
import dataclasses
import functools
import itertools
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch
from shared.document import Page, printed, quartiles, table
from shared.scenes import PAPER, paper_scene

import autdtorch as at
from autdtorch import hardware

DOCUMENT = "camera.md"
METHODS: dict[str, at.Method] = {
    "identify": at.Identify(),
    "bo_foci": at.BayesOpt(64, 4, model="foci", kernel="phasor", noise="inferred"),
    "gabs": at.GABS(16),
    "bo": at.BayesOpt(256),
}
OPTIONS = {
    "--methods": {"nargs": "+", "default": [*METHODS], "choices": METHODS, "help": "that read"},
    "--seeds": {"type": int, "default": 20, "help": "random choices of each method"},
    "--bo-seeds": {"type": int, "default": 5, "help": "of these, that bo gets: its trials are the longest"},
    "--logs": {"type": Path, "default": Path("outputs/camera_methods"), "help": "folder of the trials' logs"},
    "--processes": {"type": int, "default": 1, "help": "that run trials side by side"},
}
SIDE = 70e-3  # of the screen [m]
STRENGTHS = {"homogeneous": 20.0, "two_cubes": 30.0, "three_cubes": 30.0}  # of a transducer [Pa m]
BLOCK = 5  # trials at once
DEVICE, LIMITS = hardware.SONICSURFACE, hardware.Limits(1.0, evaluations=100_000, seconds=1e6)


def main(page: Page, methods: list[str], seeds: int, bo_seeds: int, logs: Path, processes: int) -> None:
    """Run all trials, print a row for each method and scene, and write the block."""
    logs.mkdir(parents=True, exist_ok=True)
    counts = {method: min(seeds, bo_seeds) if method == "bo" else seeds for method in methods}
    with ProcessPoolExecutor(processes) as pool:
        parts = {
            (method, scene): [
                pool.submit(weakest_foci, method, scene, block, logs) for block in blocks_of(counts[method])
            ]
            for method, scene in itertools.product(methods, PAPER)
        }
        rows = printed(
            [
                method,
                str(counts[method]),
                *(
                    summary(torch.cat([part.result() for part in parts[method, scene]], dim=1))
                    for scene in PAPER
                ),
            ]
            for method in methods
        )
    strengths = ", ".join(f"{strength:g} ({scene})" for scene, strength in STRENGTHS.items())
    page.write(
        table(["method", "seeds", *PAPER], rows),
        "The true weakest focus by the camera's drive [kPa], and its ratio to the one by microphones at the "
        "foci without noise: medians (quartiles) of seeds, for random choices and the camera's noise. Source "
        f"strengths are {strengths} Pa m, and the screen is {1e3 * SIDE:g} mm wide.",
    )


def blocks_of(seeds: int) -> list[range]:
    return [range(first, min(first + BLOCK, seeds)) for first in range(0, seeds, BLOCK)]


def summary(pressure: torch.Tensor) -> str:
    """Return the cell for pressures (2, T) [Pa] by microphones and by camera."""
    return f"{1e-3 * float(pressure[1].quantile(0.5)):.3f}: {quartiles(pressure[1] / pressure[0])}"


def weakest_foci(method: str, scene: str, trials: range, logs: Path) -> torch.Tensor:
    """Return the true pressures (2, T) [Pa] of the weakest focus by microphones and by a camera."""
    torch.set_num_threads(1)
    start, simulated = time.process_time(), simulation(scene)
    matrix = simulated.transfer_matrix
    assert matrix is not None
    with camera_bench(simulated, logs / f"{method}_{scene}_{trials.start}.jsonl", trials.start) as measured:
        drives = [
            at.run(METHODS[method], objective, trials).drive
            for objective in (hardware.Played(simulated, DEVICE, range(matrix.shape[1])), measured)
        ]
    pressure = (torch.stack(drives) @ matrix.T).abs().amin(dim=-1)
    ratios = (pressure[1] / pressure[0]).tolist()
    print(
        method,
        scene,
        *(f"{ratio:.3f}" for ratio in ratios),
        f"{time.process_time() - start:.0f} s",
        flush=True,
    )
    return pressure


@functools.cache
def simulation(name: str) -> at.SimulatedObjective:
    """Return a scene of the paper with strong transducers and a screen as its observation plane."""
    scene = paper_scene(name)
    assert scene.observation_plane is not None
    scene = dataclasses.replace(
        scene,
        array=dataclasses.replace(scene.array, source_strength=STRENGTHS[name]),
        observation_plane=dataclasses.replace(scene.observation_plane, size=(SIDE, SIDE)),
    )
    return at.SimulatedObjective(scene, at.make_propagator(scene))


@contextlib.contextmanager
def camera_bench(
    simulated: at.SimulatedObjective, log: Path, seed: int
) -> Iterator[hardware.HardwareObjective]:
    """Set up an emulated device, a screen and a camera; `seed` is of the camera's noise."""
    scene, wired = simulated.scene, range(len(simulated.scene.array))
    plane = scene.observation_plane
    bench = hardware.EmulatedBench(DEVICE, simulated.transfer_matrix, wired)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as at_the_end:
        matrix_of = at.make_propagator(scene).transfer_matrix
        emulated = hardware.EmulatedCamera(bench, matrix_of, plane, folder, seed=seed)
        at_the_end.callback(emulated.close)
        sleep = bench.bus.sleep
        frames = hardware.FolderFrames(folder, 0.01, -273.15, delete=True, clock=emulated.clock, sleep=sleep)
        corners, wavelength = emulated.corners.round(1), scene.wavelength
        sensor = hardware.ThermalCamera(frames, plane, corners, scene.control_points, wavelength=wavelength)
        link = at_the_end.enter_context(hardware.open_link(DEVICE, wired, backend=bench.bus))
        limited = hardware.LimitedLink(link, LIMITS)
        yield hardware.HardwareObjective(scene, limited, sensor, log, {"seed": seed})
