"""Small scenes, files, devices and results that public functions and methods accept."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from small_scenes import AIR, CORNER, CUBE, small_scene

import autdtorch as at
from autdtorch import hardware, propagators
from autdtorch.hardware.emulator.bench import EmulatedBus
from autdtorch.hardware.emulator.emulated_scope import EmulatedInstrument

PLANE = at.Plane(center=(20e-3, 12e-3, 12e-3), normal=(1, 0, 0), size=(8e-3, 8e-3))
AIR_ALONE = small_scene()
BALL = small_scene((at.Sphere((12e-3, 12e-3, 12e-3), radius=3e-3, rigid=True),))
SCENE = replace(small_scene((CUBE,)), observation_plane=PLANE)
MATRIX = torch.randn(3, 4, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
DRIVE = torch.ones(4, dtype=torch.complex128)
BEAD = at.Particle.of("EPS", 0.3e-3)
GRID = np.stack(np.meshgrid(*(1e-3 * np.arange(count) for count in (2, 3, 4)), indexing="ij"), axis=-1)
CHIP = (1, 2)
SPOTS = np.stack(
    [
        np.exp(-((np.arange(20) - row)[:, None] ** 2 + (np.arange(20) - column) ** 2) / 18)
        for row, column in ((5, 5), (14, 5), (5, 14), (14, 14))
    ]
)
SCENE_FILE = """
array: {type: grid, shape: [2, 2], pitch: 0.01, center: [0, 0, 0]}
medium: {density: 1.2, sound_speed: 340}
frequency: 40000
control_points: {type: points, positions: [[0.08, 0, 0]]}
"""

#: Settings with which each method ends soon.
METHODS: dict[str, dict[str, Any]] = {
    "BayesOpt": {"evaluations": 11, "initial": 3},
    "GABS": {"levels": 4},
    "GradientAscent": {"starts": 2, "steps": 3},
    "Holography": {"iterations": 2},
    "Identify": {"evaluations": 11},
    "LSS": {},
    "LSSG": {"levels": 4},
    "PhaseStepping": {},
    "RandomSearch": {"evaluations": 11},
}


class Made(NamedTuple):
    """An argument that must not be shared by two calls."""

    make: Callable[[Path], Any]


class Louder:
    """A sensor of pulses, each louder than all before."""

    def __init__(self):
        self.pulses = 0

    def read_pulse(self, on, off):
        on()
        off()
        self.pulses += 1
        return torch.full((3,), 10.0**self.pulses, dtype=torch.float64)


class Silent(hardware.Port):
    """A port that nothing hangs on, and a sensor that always reads the same."""

    def read(self):
        return torch.ones(3, dtype=torch.float64)


def written(folder: Path, name: str, content: str) -> Path:
    path = folder / name
    path.write_text(content, encoding="utf-8")
    return path


def saved(folder: Path, name: str, array: Any) -> Path:
    np.save(folder / name, array)
    return folder / name


def array_file(folder: Path) -> Path:
    return written(folder, "array.csv", "x [m],y [m],z [m]\n0,0,0\n0,0.01,0\n")


def drive_file(folder: Path) -> Path:
    return written(folder, "drive.csv", "phase [rad],amplitude\n0,1\n1,0.5\n")


def sequence_file(folder: Path) -> Path:
    array = at.TransducerArray.grid((2, 2), 10e-3, (0, 0, 0), (0, 0, 1))
    at.save_sequence(folder / "sequence.npz", at.modulated(DRIVE, 200.0), array)
    return folder / "sequence.npz"


def haptics() -> at.HapticMetrics:
    sequence = at.modulated(DRIVE, 200.0)
    return at.haptic_metrics(propagator(), sequence, AIR_ALONE.control_points)


def readings_file(folder: Path) -> Path:
    return written(folder, "readings.csv", "phase 0 [deg],phase 1 [deg],p [Pa rms]\n10,20,3\n30,40.5,5\n")


def readings() -> at.Readings:
    return at.Readings(torch.stack([DRIVE, DRIVE]), [1.0, 2.0])


@cache
def calibration() -> at.Calibration:
    return at.calibrate(MATRIX, at.Readings(torch.eye(4, dtype=torch.complex128), MATRIX.abs().T), folds=0)


def calibration_file(folder: Path) -> Path:
    at.save_calibration(folder / "calibration.npz", calibration())
    return folder / "calibration.npz"


def picture() -> hardware.Picture:
    return hardware.Picture(
        PLANE, torch.ones(4, 4, dtype=torch.float64), torch.ones(4, 4, dtype=torch.float64)
    )


def registration() -> hardware.Registration:
    return hardware.Registration(PLANE, np.array([[1e3, 0.0, 9.5], [0.0, 1e3, 9.5], [0.0, 0.0, 1.0]]))


def heat_inversion() -> hardware.HeatInversion:
    return hardware.HeatInversion(registration(), (20, 20), (4, 4), 8.5e-3)


def picture_file(folder: Path) -> Path:
    at.save_picture(folder / "picture.npz", picture())
    return folder / "picture.npz"


def mesh_file(folder: Path) -> Path:
    return written(folder, "corner.obj", CORNER)


def board_file(folder: Path) -> Path:
    places = (f"({1e-2 * (number % 16)}, {1e-2 * (number // 16)}, 0)" for number in range(256))
    lines = ["board", "256", "128", *places, *map(str, range(256)), *["0"] * 256, *["1"] * 256]
    return written(folder, "board.pat", "\n".join(lines))


@cache
def propagator(scene: at.Scene = AIR_ALONE, *settings: Any, **named: Any) -> propagators.Propagator:
    """A propagator, which all calls may share: it is not changed."""
    return at.make_propagator(scene, *settings, **named)


@cache
def operator() -> at.TMatrix:
    return at.TMatrix.of(at.Sphere((40e-3, 12e-3, 12e-3), radius=4e-3, rigid=True), AIR, 40e3)


def objective() -> at.SimulatedObjective:
    return at.SimulatedObjective(AIR_ALONE, propagator())


def force_objective() -> at.ForceObjective:
    return at.ForceObjective(propagator(), at.Trap([(22e-3, 7e-3, 14e-3)], particle=BEAD))


def problem() -> at.Problem:
    return at.Problem.of(objective())


@cache
def state(method: str) -> at.State:
    """A state of the method at its beginning."""
    return made(method).start(problem())


@cache
def made(method: str) -> Any:
    """A method that ends soon."""
    return getattr(at, method)(**METHODS[method])


def observed(state: at.State) -> torch.Tensor:
    return torch.ones(*state.drives.shape[:2], 3, dtype=torch.float64)


def state_file(folder: Path) -> Path:
    at.save_state(folder / "state.npz", made("GABS"), state("GABS"))
    return folder / "state.npz"


def link() -> hardware.Link:
    return hardware.Link(hardware.SONICSURFACE, Silent(), [3, 1, 7, 5], sleep=lambda _: None)


@cache  # it takes a while to find the levels within a limit
def limited_link() -> hardware.LimitedLink:
    return hardware.LimitedLink(link(), hardware.Limits(1.0))


def bench() -> hardware.EmulatedBench:
    return hardware.EmulatedBench(hardware.SONICSURFACE, MATRIX, [3, 1, 7, 5])


def image() -> Any:
    """An image of 2 by 2 by 2 voxels of a body."""
    import pyvista

    grid = pyvista.ImageData(dimensions=(3, 3, 3), spacing=(1e-3,) * 3)
    grid.cell_data["body"] = np.ones(8, np.uint8)
    return grid


def scope() -> hardware.Oscilloscope:
    return hardware.open_scope(CHIP, backend=scope_bus())


def scope_bus() -> EmulatedBus:
    heard = hardware.EmulatedScope(lambda: MATRIX[:, 0], 40e3, 0.01, (0, 1))
    return EmulatedBus([EmulatedInstrument(*CHIP, "EMULATED", heard)])
