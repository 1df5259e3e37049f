"""Every public function and method, with an accepted argument for each of its parameters.

Arguments belong to names of parameters, which have one meaning almost everywhere. A new function is called as
soon as it is public; add a parameter with a new name or another meaning here, unless it has a default.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
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

METHODS = (
    *("BayesOpt", "GABS", "GradientAscent", "Holography", "Identify"),
    *("LSS", "LSSG", "PhaseStepping", "RandomSearch"),
)

#: Results, parts of drivers, and calls that need a device.
NOT_CALLED_BY_USERS = """
Adapter Calibration Device Dialect Estimate Evaluation EvaluationLog FocusMetrics Goal HapticMetrics Method
Obstacle OpenMPDBoard Picture Playback Preflight Run SimulatedPropagator Solution State Sweep TMatrix
TMatrixPropagator UsbtmcPort Waveform
CallableFrames.wait Device.pack EmulatedBench.receive EmulatedScope.execute EmulatedScope.plug_into
FolderFrames.wait Oscilloscope.capture Oscilloscope.set_up ThermalCamera.deviation ThermalCamera.read_pulse
LimitedLink.play_sequence Link.play_sequence Link.play_prepared
lock_log open_autd3 uvc_frames
"""

#: Methods that the driver calls, and that authors of methods implement.
INSIDE_METHODS = """
advance at begin by_poses by_waves check checked climbed coarser farthest for_scene forms forward
images_around in_poses joined levels most_at_once most_evaluations near numbers_kept offsets recorded
require_fit section slope some_poses together_on wanted worst_bound write_file
"""


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
    """A state of the method with the arguments of this file."""
    return made(method).start(problem())


@cache
def made(method: str) -> Any:
    call = Call(method, getattr(at, method))
    return call.function(**call.arguments(Path()))


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


#: By name of the parameter; others have the default value.
ARGUMENTS: dict[str, Any] = {
    **dict.fromkeys(("background", "boards", "captures", "input", "reads"), 1),
    **dict.fromkeys(("frames", "starts"), 2),
    **dict.fromkeys(("count", "foci", "initial", "max_periods", "steps"), 3),
    **dict.fromkeys(("levels", "periods"), 4),
    **dict.fromkeys(("pitch", "sensitivity", "thickness"), 0.01),
    **dict.fromkeys(("spacing", "tolerance"), 2e-3),
    "settle": 0.0,
    **dict.fromkeys(("amplitude", "gain", "loudest"), 1.0),
    **dict.fromkeys(("center", "focus", "offset", "origin"), (12e-3, 11e-3, 13e-3)),
    **dict.fromkeys(("axis", "normal", "normals"), (1.0, 0.1, 0.2)),
    **dict.fromkeys(("xlabel", "ylabel"), "text"),
    **dict.fromkeys(("observation_plane", "plane"), PLANE),
    **dict.fromkeys(("G", "transfer_matrix"), MATRIX),
    "fixed_transducer": 0,
    "kelvin": 1.0,
    "amplitudes": [1.0, 0.5, 1.0, 1.0],
    "angle": 0.3,
    "array": SCENE.array,
    "ask": lambda question: "1",
    "backend": Made(lambda _: bench().bus),
    "bench": Made(lambda _: bench()),
    "calibration": Made(lambda _: calibration()),
    "cell_area": 1e-6,
    "check": hardware.Preflight(torch.ones(4), silence=1.0, threshold=2.0),
    "chip": CHIP,
    "control_points": SCENE.control_points,
    "costs": {"time [s]": {"size": {"gabs": [[1.0, 1.0], [2.0, 3.0]]}}},
    "failed": [1],
    "density": 100.0,
    "density_ratio": 2.0,
    "dialect": hardware.KEYSIGHT,
    "distance": [0.1, 0.2],
    "domain": SCENE.domain,
    "drive": DRIVE,
    "duration": 0.5,
    "images": np.random.default_rng(0).normal(22, 0.05, (24, 20, 20)),
    "times": np.linspace(-0.4, 0.8, 24),
    "measured": 1000.0,
    "pictured": 900.0,
    "registration": Made(lambda _: registration()),
    "evaluations": 11,
    "field": torch.ones(4, 4, dtype=torch.complex128),
    "folder": Made(lambda folder: folder),
    "force": np.ones((2, 2, 3)),
    "frequency": 40e3,
    "goal": at.WeakestFocus(),
    "height": 5e-3,
    "history": {"scene": {"gabs": [[1.0, 2.0]]}},
    "isosurface": -3.0,
    "limits": hardware.Limits(1.0),
    "link": Made(lambda _: limited_link()),
    "log": Made(lambda folder: folder / "log.jsonl"),
    "mask": np.ones((2, 2, 2), bool),
    "material": "EPS",
    "medium": AIR,
    "method": "box",
    "microphones": [hardware.Microphone(1, 0.01, 1.0)],
    "names": {"scene": {"gabs": ["a", "b"]}},
    "objective": Made(lambda _: objective()),
    "obstacles": (CUBE,),
    "off_screen": True,
    "particle": BEAD,
    "point": (22e-3, 7e-3, 14e-3),
    "path": Made(lambda folder: folder / "file.npz"),
    "phases": [0.0, 1.0, 2.0, 3.0],
    "picture": Made(lambda _: picture()),
    "plane_pressure": [[1.0, 2.0], [1.0, 2.0]],
    "planes": {"scene": PLANE},
    "X": torch.full((2, 3), 0.5, dtype=torch.float64),
    "points": [[22e-3, 7e-3, 14e-3], [20e-3, 16e-3, 12e-3]],
    "port": Silent(),
    "positions": [[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]],
    "pressure": [1.0, 2.0],
    "problem": Made(lambda _: problem()),
    "propagator": Made(lambda _: propagator()),
    "quantities": {"pressure [Pa]": {"scene": {"gabs": [1.0, 2.0]}}},
    "radius": 3e-3,
    "rate": 1000.0,
    "ratio": 0.1,
    "readings": Made(lambda _: at.Readings(DRIVE[None], [[1.0, 2.0, torch.nan]])),
    "rotation": (0.0, 0.0, 0.1),
    "scale": 1e-3,
    "scene": SCENE,
    "scope": Made(lambda _: scope()),
    "seconds": 10.0,
    "seconds_in_a_row": 5.0,
    "sensor": Silent(),
    "sequence": at.Sequence(torch.stack([DRIVE, DRIVE]), 50.0),
    "settings": {"a": 1},
    "shape": (2, 2),
    "size": (4e-3, 4e-3, 4e-3),
    "sleep": lambda seconds: None,
    "snr": 20.0,
    "sound_speed": 340.0,
    "source": Made(lambda folder: written(folder, "scene.yaml", SCENE_FILE)),
    "sources": [[0.1, 0.02, 0.03], [0.2, 0.0, 0.0]],
    "speed_ratio": 1.5,
    "timeout": 0.1,
    "stop": lambda state: True,
    "transducers": [3, 1, 7, 5],
    "vmax": 3.0,
    "vmin": 0.5,
    "volume": torch.ones(3, 3, 3, dtype=torch.complex128),
    "wavelength": 8.5e-3,
    "wavenumber": 7.0,
}

#: Where a name means something else.
OTHERS: dict[str, Any] = {
    "FailedTransducers.transducers": [1],
    "ForceObjective.goal": at.Trap([(22e-3, 7e-3, 14e-3)], particle=BEAD),
    "ForceSensor.noise": 1e-6,
    "ForceSensor.objective": Made(lambda _: force_objective()),
    "equilibrium.propagator": Made(lambda _: at.make_propagator(AIR_ALONE)),
    "OverScenes.scenes": 1,
    "PoseBall.propagator": Made(lambda _: propagator(BALL, "tmatrix")),
    "PoseBall.radius": 1e-4,
    "Push.body": 0,
    "Push.direction": (0.0, 0.0, 1.0),
    "Scenarios.around.failed": 1,
    "Scenarios.around.offset": 1e-4,
    "Scenarios.around.rotation": 0.0,
    "Scenarios.around.propagator": Made(lambda _: propagator(BALL, "tmatrix")),
    "Scenarios.objectives": Made(lambda _: [objective()]),
    "robust_drive.ball": Made(lambda _: at.PoseBall(propagator(BALL, "tmatrix"), 1e-4)),
    "robust_drive.method": Made(lambda _: made("GABS")),
    "Particle.radius": 3e-4,
    "Particle.of.radius": 3e-4,
    "Drift.sensor": 0.1,
    "EmulatedScope.noise": 0.0,
    "CallableFrames.take": lambda: np.ones((4, 4)),
    "Frame.image": np.ones((4, 4)),
    "Frame.time": 1.0,
    "FolderFrames.folder": Made(lambda folder: folder),
    "ThermalCamera.corners": [[0, 0], [0, 9], [9, 0], [9, 9]],
    "Screen.calibrated.measured": 2.0,
    "Screen.calibrated.pictured": 1.0,
    "ThermalCamera.frames": Made(lambda _: hardware.CallableFrames(lambda: np.ones((4, 4)))),
    "ThermalCamera.points": None,
    "Registration.matrix": np.eye(3),
    "Registration.of.pixels": [[0, 0], [0, 9], [9, 0], [9, 9]],
    "Registration.of.places": PLANE.corners,
    "Registration.on_grid.counts": (4, 4),
    "Registration.on_grid.image": np.ones((20, 20)),
    "Registration.to_pixels.coordinates": [[1e-3, 2e-3]],
    "Registration.to_plane.pixels": [[1.0, 2.0]],
    "HeatInversion.counts": (4, 4),
    "HeatInversion.shape": (20, 20),
    "registered_by_foci.places": PLANE.corners,
    "registered_by_foci.rises": SPOTS,
    "Screen.absorbed": 0.1,
    "EmulatedCamera.bench": Made(lambda _: bench()),
    "EmulatedCamera.folder": Made(lambda folder: folder),
    "EmulatedCamera.matrix_of": lambda points: torch.ones(len(points), 4, dtype=torch.complex128),
    "EmulatedScope.points": (0, 1),
    "EmulatedScope.pressure": lambda: MATRIX[:, 0],
    "HardwareObjective.scene": AIR_ALONE,
    "LimitedLink.link": Made(lambda _: link()),
    "LimitedLink.go_on.seconds": 0.1,
    "Medium.air.pressure": 1e5,
    "Mesh.from_surface.surface": Made(lambda _: CUBE.surface()),
    "Mesh.path": Made(mesh_file),
    "OpenMPDBoard.load.path": Made(board_file),
    "QuietPoints.points": [1],
    "SeenPoints.points": [1],
    "Sequence.drives": torch.stack([DRIVE, DRIVE]),
    "modulated.frequency": 200.0,
    "sequence_along.frequency": 10.0,
    "sequence_along.path": [[22e-3, 7e-3, 14e-3], [20e-3, 16e-3, 12e-3]],
    "sequence_along.targets": [1.0],
    "haptic_metrics.path": None,
    "plot_haptics.metrics": Made(lambda _: haptics()),
    "save_sequence.array": at.TransducerArray.grid((2, 2), 10e-3, (0, 0, 0), (0, 0, 1)),
    "load_sequence.path": Made(sequence_file),
    "Readings.drives": torch.stack([DRIVE, DRIVE]),
    "Readings.pressure": [[1.0, 2.0], [3.0, 4.0]],
    "Readings.phase": [[0.1, 0.2], [0.3, 0.4]],
    "Readings.of_rows.drives": torch.stack([DRIVE, DRIVE]),
    "Readings.of_rows.phase": [0.1, 0.2],
    "Contrast.points": [1],
    "TargetPressures.targets": [1.0, 2.0, 3.0],
    "TargetPressures.__call__.pressure": [1.0, 2.0, 3.0],
    "PhasorKernel.mean.x": torch.ones(3, 2, dtype=torch.float64),
    "Problem.transducers": 4,
    "Oscilloscope.port": Made(lambda _: scope()._port),
    "Picture.foci.near": [PLANE.center],
    "Plane.size": (0.1, 0.1),
    "Scene.equals.other": AIR_ALONE,
    "porous.flow_resistivity": 1e5,
    "polyline_points.corners": [[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]],
    "Reflector.point": (0.0, 0.0, 0.0),
    "SimulatedObjective.scene": AIR_ALONE,
    "VoxelMask.from_image.image": Made(lambda _: image()),
    "VoxelMask.from_image.name": None,
    "VoxelMask.load.path": Made(lambda folder: saved(folder, "mask.npy", np.ones((2, 2, 2), bool))),
    "animate3d.path": Made(lambda folder: folder / "wave.gif"),
    **{f"{name}.evaluations": 4 for name in ("bayes_opt", "bo_foci")},
    "calibrate.folds": 0,
    "holography.iterations": 2,
    "robust_drive.rounds": 1,
    "cell_centers.scene": AIR_ALONE,
    "Calibration.predict.drives": DRIVE,
    "Calibration.predict.points": None,
    "calibrate.propagator_or_matrix": MATRIX,
    "NearbyPoses.transfer_matrix.offset": (1e-4, 0.0, 0.0),
    "NearbyPoses.propagator": Made(lambda _: propagator(SCENE, "box", 1e-3, 0.5, max_periods=6)),
    "check_picture.readings": 1,
    "check_picture.sensor": Made(lambda _: Louder()),
    "check_transducers.readings": 1,
    "differentiable_field.density": [50.0],
    "differentiable_field.sound_speed": [340.0],
    "load_calibration.path": Made(calibration_file),
    "load_state.method": Made(lambda _: made("GABS")),
    "load_state.path": Made(state_file),
    "run.method": Made(lambda _: made("GABS")),
    "save_state.method": Made(lambda _: made("GABS")),
    "save_state.state": Made(lambda _: state("GABS")),
    "load_picture.path": Made(picture_file),
    "load_readings.source": Made(readings_file),
    "load_readings.columns": None,
    "load_readings.phases": "deg",
    "load_readings.pressure": "rms",
    "load_readings.phase": None,
    "load_readings.points": [[0.0, 0.0, 0.1]],
    "save_readings.readings": Made(lambda _: readings()),
    "load_array.path": Made(array_file),
    "load_drive.path": Made(drive_file),
    "explore.port": 0,
    "save_scene.path": Made(lambda folder: folder / "scene.yaml"),
    "open_link.port": None,
    "open_scope.backend": Made(lambda _: scope_bus()),
    "openmpd_boards.boards": Made(lambda folder: [at.OpenMPDBoard.load(board_file(folder))]),
    "plot_convergence.levels": {"scene": {"bound": 3.0}},
    "plot_pareto.points": {"scene": {"gabs": [[1.0, 1.0], [2.0, 3.0]]}},
    "plot_force.pressure": np.ones((4, 4)),
    "plot_plane.decibels": True,
    "plot_plane.pressure": np.ones((4, 4)),
    "plot_plane.reference": 2.0,
    "plot_planes.control_points": {"scene": SCENE.control_points},
    "plot_planes.obstacles": {"scene": (CUBE,)},
    "plot_planes.pressure": {"scene": {"gabs": np.ones((4, 4))}},
    "save_field.path": Made(lambda folder: folder / "field.vti"),
    "plot_poses.scores": {"gabs": [[1.0, 2.0], [2.0, 3.0]]},
    "plot_poses.places": [0.0, 1.0],
    "plot_poses.bounds": [3.0, 3.0],
    "TMatrixCluster.bodies": Made(lambda _: [operator()]),
    **{
        f"{name}.bodies": Made(lambda _: propagator(BALL, "tmatrix"))
        for name in ("force_matrices", "radiation_force", "radiation_torque")
    },
    "save_field.points": GRID,
    "save_field.pressure": torch.ones(2, 3, 4, dtype=torch.complex128),
    "weakest_focus.pressure": torch.ones(2, 3),
    **{f"{kind}.device": hardware.SONICSURFACE for kind in ("EmulatedBench", "Link", "Played", "open_link")},
    "impedance_plane.impedance": 5.0,
    "impedance_sphere.impedance": 5.0,
    **{f"{kind}_sphere.center": (0.0, 0.0, 0.0) for kind in ("fluid", "rigid", "soft")},
    **{
        f"{name}.{call}.state": Made(lambda _, name=name: state(name))
        for name in METHODS
        for call in ("ask", "best", "tell")
    },
    **{f"{name}.tell.pressure": Made(lambda _, name=name: observed(state(name))) for name in METHODS},
}

#: Of classes that users do not make themselves.
INSTANCES = {
    "Calibration": Made(lambda _: calibration()),
    "SimulatedPropagator": Made(lambda _: propagator(SCENE, "box", 2e-3, 0.5, max_periods=6)),
    "TMatrixPropagator": Made(lambda _: propagator(BALL, "tmatrix")),
    "Medium": Made(lambda _: AIR),
    "TMatrix": Made(lambda _: operator()),
    "TMatrixCluster": Made(lambda _: at.TMatrixCluster([operator()])),
    "ForceObjective": Made(lambda _: force_objective()),
    "ForceSensor": Made(lambda _: at.ForceSensor(force_objective())),
    "HeatInversion": Made(lambda _: heat_inversion()),
    "Picture": Made(lambda _: picture()),
    "OpenMPDBoard": Made(lambda folder: at.OpenMPDBoard.load(board_file(folder))),
}


class Call(NamedTuple):
    """A public function, class or method; `owner` is the class of a method that needs an instance."""

    name: str
    function: Callable[..., Any]
    owner: type | None = None

    @property
    def parameters(self) -> dict[str, str]:
        """Annotations by name."""
        return _annotations(self.function)

    def argument(self, parameter: str, folder: Path) -> Any:
        """A value that it accepts for a parameter."""
        default = _parameters(self.function)[parameter].default
        value = OTHERS.get(f"{self.name}.{parameter}", ARGUMENTS.get(parameter, default))
        assert value is not inspect.Parameter.empty, f"add {self.name}.{parameter} to public_calls.py"
        return value.make(folder) if isinstance(value, Made) else value

    def arguments(self, folder: Path, /, **chosen: Any) -> dict[str, Any]:
        """Values that it accepts, by parameter, with some chosen."""
        return {
            name: chosen[name] if name in chosen else self.argument(name, folder) for name in self.parameters
        }

    def bound(self, folder: Path) -> Callable[..., Any]:
        """The function, of an instance if it needs one."""
        if self.owner is None:
            return self.function
        maker = INSTANCES.get(self.owner.__name__)
        maker_call = Call(self.owner.__name__, self.owner)
        instance = (
            maker_call.function(**maker_call.arguments(folder)) if maker is None else maker.make(folder)
        )
        return getattr(instance, self.function.__name__)


@cache
def _parameters(function: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(function).parameters


@cache
def _annotations(function: Callable[..., Any]) -> dict[str, str]:
    parameters = _parameters(function).values()
    return {one.name: str(one.annotation) for one in parameters if one.name != "self"}


def public_calls() -> dict[str, Call]:
    """All that have parameters, by name; a method that classes inherit is that of the first of them."""
    calls = [
        call
        for module in (at, at.analytic, hardware, propagators)
        for name in getattr(module, "__all__", dir(module))
        if callable(thing := getattr(module, name))
        for call in (_calls_of(thing) if inspect.isclass(thing) else [Call(name, thing)])
    ]
    called = [call for call in calls if call.parameters and call.name not in NOT_CALLED_BY_USERS.split()]
    return {call.name: call for call in {call.function: call for call in reversed(called)}.values()}


def _calls_of(kind: type) -> Iterator[Call]:
    """The constructor and the methods of a class."""
    protocol = getattr(kind, "_is_protocol", False)
    not_made = kind.__name__ in NOT_CALLED_BY_USERS.split() and kind.__name__ not in INSTANCES
    if issubclass(kind, BaseException) or protocol or not_made:
        return
    yield Call(kind.__name__, kind)
    # fields, as defaults may be functions
    inner = {*INSIDE_METHODS.split(), *getattr(kind, "__dataclass_fields__", {})}
    for name in dir(kind):
        member = inspect.getattr_static(kind, name)
        if isinstance(member, classmethod) and name[0] != "_":
            yield Call(f"{kind.__name__}.{name}", getattr(kind, name))
        elif not inspect.isfunction(member) or not member.__module__.startswith("autdtorch"):
            continue  # such as a method that comes from GPyTorch
        elif name not in inner and (name == "__call__" or name[0] != "_"):
            yield Call(f"{kind.__name__}.{name}", member, kind)
