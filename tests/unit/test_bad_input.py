"""Bad arguments of public functions end in one line that names the field, the value and what is accepted."""

import warnings
from collections import UserList, deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from public_calls import Call, public_calls
from wrong_values import Wrong, spoiled, wrong_values

import autdtorch as at
from autdtorch.plot import explore
from autdtorch.scene.drive import normalise, validate_drive
from autdtorch.scene.geometry import plane_basis

CALLS = public_calls()

#: The call that sees all wrong values of a parameter; others of this name and annotation see a sixth of them.
FIRST = {key: call.name for call in reversed(CALLS.values()) for key in call.parameters.items()}

EXPECTED = {
    ("load_scene", "source", "a dict"),  # a scene without the keys that it needs
    ("view3d", "volume", "itself, with nan"),  # unknown values of a volume
    ("Frame", "image", "itself, with nan"),  # saturated pixels
    ("plot_poses", "bounds", "itself, with inf"),  # no bound is known
    *(
        (call, name, "itself, with nan")  # gaps
        for call in ("Readings", "Readings.of_rows")
        for name in ("pressure", "phase")
    ),
    # pixels that say nothing
    *(
        (call, name, "itself, with nan")
        for call, name in (
            ("HeatInversion.fitted_screen", "images"),
            ("HeatInversion.picture", "images"),
            ("Registration.on_grid", "image"),
            ("registered_by_foci", "rises"),
        )
    ),
    # whole metres, which move the obstacles out of the domain
    *(
        (call, "offset", f"a tensor {kind}")
        for call in ("Scene.moved", "NearbyPoses.transfer_matrix")
        for kind in ("of 8 bits", "of unsigned integers", "with gradient")
    ),
    *(("Scenarios.around", "rotation", kind) for kind in ("1.5", "a tensor of 8 bits")),  # of a sphere
}

#: Kinds of annotations that let a kind of value in.
LET_IN = {
    type(None): ("None", "Any"),
    bool: ("bool", "Literal[False]"),
    str: ("str", "Literal", "Path"),
    bytes: (),
}


class Accepted(Exception):
    """All arguments were checked; nothing needs to be drawn or simulated."""


def unfitted(_: Callable[..., Any], start: np.ndarray, **__: Any) -> SimpleNamespace:
    """The solution of a fit: where it starts."""
    return SimpleNamespace(x=start)


@pytest.fixture(autouse=True)
def the_checks_are_all(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: Any, **__: Any) -> None:
        raise Accepted

    monkeypatch.setattr("autdtorch.plot.style.ShownFigure", stop)
    monkeypatch.setattr("autdtorch.plot.plane_maps.draw_plane", stop)  # into axes of the user
    monkeypatch.setattr("autdtorch.plot.view3d.require_rendering", stop)
    monkeypatch.setattr(explore, "require_rendering", stop)
    monkeypatch.setattr("autdtorch.hardware.camera.registration.least_squares", unfitted)
    monkeypatch.setattr("autdtorch.propagators.propagator.are_shown", stop)
    monkeypatch.setattr("autdtorch.propagators.differentiable.recorded", stop)
    monkeypatch.setattr("autdtorch.methods.run.show_progress", stop)
    monkeypatch.setattr(at.NearbyPoses, "_coarse", stop)
    monkeypatch.setattr("autdtorch.propagators.scene_changes.SceneChanges.matrix", stop)


def refusal(function: Callable[..., Any], arguments: dict[str, Any]) -> Exception | None:
    """Return the error of a call with these arguments; warnings of results and renames do not count."""
    with warnings.catch_warnings():
        for kind in (at.ScaleWarning, at.SteadyStateWarning, DeprecationWarning):
            warnings.simplefilter("ignore", kind)
        try:
            function(**arguments)
        except Accepted:
            return None
        except Exception as error:
            return error
    return None


def complaint(call: Call, parameter: str, wrong: Wrong, error: Exception | None) -> str | None:
    """Return what is not as promised, if anything."""
    annotation = call.parameters[parameter]
    barred = type(wrong.value) in LET_IN and not any(kind in annotation for kind in LET_IN[type(wrong.value)])
    if error is None:
        return "taken" if wrong.never or barred else None
    if isinstance(error, OSError) and not wrong.never:
        return None  # accepted, but there is no such file or device
    text = str(error)
    if not isinstance(error, ValueError | TypeError):
        return f"{type(error).__name__}: {text[:200]}"
    field = text.partition(":")[0]
    if "\n" in text or len(text) > 500 or not any(name in field for name in call.parameters):
        return f"not one line of a field: {text[:200]!r}"
    return None


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS.keys())
def test_a_value_of_a_wrong_kind_is_refused_in_a_line_that_names_the_field(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function = call.bound(tmp_path)
    complaints = []
    for parameter, annotation in call.parameters.items():
        valid = call.argument(parameter, tmp_path)
        values = [*wrong_values(), *spoiled(valid)]
        if FIRST[parameter, annotation] != call.name:
            values = values[len(call.name) % 6 :: 6]
        others = None
        for wrong in values:
            if annotation == "Any" or (callable(valid) and callable(wrong.value)):
                continue  # errors of a function show where it is called
            if others is None:
                others = call.arguments(tmp_path, **{parameter: None})
            error = refusal(function, {**others, parameter: wrong.value})
            if error is None:
                others = None  # the call may have changed or ended them
            text = complaint(call, parameter, wrong, error)
            if text and (call.name, parameter, wrong.name) not in EXPECTED:
                complaints.append(f"{parameter} = {wrong.name}: {text}")
    if complaints:
        pytest.fail("\n".join(complaints), pytrace=False)


FOCI = at.circle_points((80e-3, 50e-3, 50e-3), 30e-3, 4, (1, 0, 0))
AIR = at.Medium(1.293, 340.0)
FAR = 1e200
ROOM = ((0, 0, 0), (0.1, 0.1, 0.1))  # m


def grid(**changes: Any) -> at.TransducerArray:
    defaults = {"shape": (4, 4), "pitch": 10e-3, "center": (1e-3, 50e-3, 50e-3), **changes}
    return at.TransducerArray.grid(**defaults)


def scene(**changes: Any) -> at.Scene:
    return at.Scene(**{"array": grid(), "medium": AIR, "frequency": 40e3, "control_points": FOCI, **changes})


def box(**changes: Any) -> at.Box:
    defaults = {"center": (41e-3, 50e-3, 50e-3), "size": (10e-3,) * 3, "density": 100.0, "sound_speed": 340.0}
    return at.Box(**defaults | changes)


def plane(*size: float) -> at.Plane:
    return at.Plane((80e-3, 50e-3, 50e-3), (1, 0, 0), size)


#: Of constructors and public calls by name: a bad argument, and the message of field, value and range.
OUT_OF_RANGE: dict[Callable[..., Any] | str, list[tuple[dict[str, Any], str]]] = {
    "Medium": [
        ({"density": -1.2}, "Medium.density: -1.2 kg/m^3; must be finite and > 0"),
        ({"density": FAR}, "Medium.density: 1e+200 kg/m^3; must be in 1e-09 to 1e+09"),
        ({"sound_speed": FAR}, "Medium.sound_speed: 1e+200 m/s; must be in 0.001 to 1e+06"),
        ({"absorption": -1}, "Medium.absorption: -1 dB/m; must be finite and >= 0"),
    ],
    "Medium.air": [
        ({"temperature": 70.0}, "temperature: 70.0 deg C; must be in -20 to 50"),
        ({"relative_humidity": 120}, "relative_humidity: 120 %; must be in 0 to 100"),
        ({"pressure": 1013.25}, "pressure: 1013.25 Pa; must be in 50000 to 200000"),
        ({"frequency": 2e6}, "frequency: 2000000.0 Hz; must be in 40 to 1e+06"),
    ],
    box: [
        ({"size": (0.01, -1, 0.01)}, "Box.size: (0.01, -1, 0.01) m; every entry must be finite and > 0"),
        ({"size": (0.01, 0.01)}, "Box.size: (0.01, 0.01); must be 3 real numbers [m]"),
        ({"rigid": True}, "Box.rigid: (100.0, 340.0); must have either a material or rigid=True"),
        ({"density": None, "sound_speed": None}, "Box.density: None; must have both density and sound_speed"),
        ({"density": 1 / FAR}, "Box.density: 1e-200 kg/m^3; must be in 1e-09 to 1e+09"),
    ],
    "Box.contains": [
        ({"points": [1.0, 2.0]}, "points: shape (2,); must be (..., 3)"),
        ({"margin": -1e-3}, "margin: -0.001 m; must be finite and >= 0"),
    ],
    "Sphere": [({"radius": -1e-3}, "Sphere.radius: -0.001 m; must be finite and > 0")],
    "Cylinder": [
        ({"axis": (0, 0, 0)}, "Cylinder.axis: (0, 0, 0); must be a vector of finite length > 1e-09")
    ],
    "Mesh": [
        ({"path": "chair.step"}, "Mesh.path: 'chair.step'; must end in one of .stl, .obj, .ply"),
        ({"path": "no/such.stl"}, "Mesh.path: 'no/such.stl'; must be an existing file"),
        ({"scale": 0}, "Mesh.scale: 0; must be finite and > 0"),
    ],
    "VoxelMask": [
        ({"mask": np.ones(1, bool)}, "VoxelMask.mask: (True,); must be an array (nx, ny, nz) of bool"),
        ({"mask": np.zeros((2, 3, 4), bool)}, "mask: array of shape (2, 3, 4); must be True somewhere"),
        ({"spacing": 0}, "VoxelMask.spacing: 0 m; must be finite and > 0"),
    ],
    "VoxelMask.load": [
        ({"path": "no/such.npy"}, "VoxelMask.path: 'no/such.npy'; must be a .npy or .npz file (")
    ],
    "TransducerArray": [
        ({"positions": [[0, 0]]}, "TransducerArray.positions: shape (1, 2); must be (P, 3)"),
        ({"positions": [[0, 0, 0], [0, 1, 0], [0, 0, 1e-10]]}, "positions: points 0 and 2 coincide at (0.0,"),
        ({"normals": [[1, 0, 0], [0, 0, 0]]}, "TransducerArray.normals[1]: (0.0, 0.0, 0.0); must"),
        ({"normals": [[1, 0, 0]] * 3}, "normals: shape (3, 3); must be (3,) or (2, 3)"),
        ({"phase": [0.1, float("nan")]}, "TransducerArray.phase: (0.1, nan) rad; every entry must be finite"),
        ({"phase": [0.1] * 3}, "TransducerArray.phase: shape (3,); must be a number or (2,) as positions"),
    ],
    "TransducerArray.calibrated": [
        ({"gain": 0.0}, "gain: 0.0; must be finite and > 0"),
        ({"gain": [1.0] * 3}, "gain: shape (3,); must be a number or (2,)"),
        ({"phase": float("inf")}, "phase: inf rad; must be"),
    ],
    grid: [
        ({"source_strength": 0.0}, "TransducerArray.source_strength: 0.0 Pa m; must be finite and > 0"),
        ({"pitch": 0}, "pitch: 0 m; must be finite and > 0"),
        ({"shape": (0, 4)}, "shape[0]: 0; must be an integer >= 1"),
        ({"shape": 4}, "shape: 4; must be 2 integers >= 1"),
        ({"radius": -1e-3}, "TransducerArray.radius: -0.001 m; must be finite and >= 0"),
        ({"radius": 5.1e-3}, "TransducerArray.radius: 0.0051 m; must be at most 0.005 m, half the distance"),
    ],
    "circle_points": [({"radius": -0.03}, "radius: -0.03 m; must be finite and > 0")],
    "polyline_points": [
        ({"corners": [[0, 0, 0]]}, "corners: shape (1, 3); must be (K, 3) with K >= 2"),
        ({"corners": [[0, 0, 0]] * 3}, "must not all be in one place"),
        ({"count": 1, "closed": False}, "count: 1"),
        ({"closed": "no"}, "closed: 'no'"),
    ],
    plane_basis: [
        ({"normal": (1, 0, 0, 0)}, "normal: (1, 0, 0, 0); must be 3 real numbers"),
        ({"normal": (1e-12, 0, 0)}, "normal: (1e-12, 0, 0); must be a vector of finite length > 1e-09"),
    ],
    "Plane": [({"size": (0.1, 0)}, "Plane.size: (0.1, 0) m; every entry must be finite and > 0")],
    "Plane.points": [({"spacing": -1e-3}, "spacing: -0.001 m; must be finite and > 0")],
    "drive_from_phases": [
        ({"amplitudes": [0.5, 1.5]}, "amplitudes: from 0.5 to 1.5; every entry must be in [0, 1]"),
        ({"amplitudes": [1.0] * 3}, "amplitudes: shape (3,); must broadcast with phases, (4,)"),
        ({"phases": 1.0}, "phases: shape (); must be (..., M)"),
    ],
    validate_drive: [
        ({"drive": [1.1j, 0], "transducers": 2}, "drive: amplitude 1.1; every |q| must be in [0, 1]"),
        ({"drive": [1j, 0], "transducers": 16}, "drive: shape (2,); must be (..., 16)"),
    ],
    normalise: [
        ({"drive": torch.tensor([[1j, 0], [0, 0]])}, "drive: 0 for every transducer; at least one amplitude")
    ],
    "focus_phases": [
        ({"focus": (1, 2)}, "focus: (1, 2); must be 3 real numbers [m]"),
        ({"wavenumber": 0.0}, "wavenumber: 0.0 rad/m; must be finite and > 0"),
    ],
    "green": [
        ({"points": [[0.1, 0.02, 0.03]]}, "points[0]: (0.1, 0.02, 0.03) m; lies on source 0, must be at lea"),
        ({"wavenumber": 1 - 0.1j}, "wavenumber.imag: -0.1 Np/m; must be finite and >= 0"),
    ],
    "rigid_sphere": [
        ({"points": [[0, 0, 0]]}, "points[0]: (0.0, 0.0, 0.0) m, 0 m from the centre of the sphere; must"),
        ({"sources": [[0, 0, 0]]}, "sources[0]: (0.0, 0.0, 0.0) m, 0 m from the centre of the sphere; must"),
        ({"points": [[0.1, 0.02, 0.03]]}, "points[0]: (0.1, 0.02, 0.03) m; lies on source 0"),
        ({"radius": -1.0}, "radius: -1.0 m; must be finite and > 0"),
    ],
    "fluid_sphere": [({"density_ratio": 0.0}, "density_ratio: 0.0; must be finite and > 0")],
    "rigid_plane": [
        ({"points": [[-1, 0, 0]]}, "points[0]: (-1.0, 0.0, 0.0) m, -"),
        ({"sources": [[-1, 0, 0]]}, "sources[0]: (-1.0, 0.0, 0.0) m, -"),
    ],
    "fluid_half_space": [({"sources": [(12e-3, 11e-3, 13e-3)]}, "m, 0 m in front of the plane; must be")],
    "fluid_slab": [({"thickness": 0.0}, "thickness: 0.0 m; must be finite and > 0")],
    scene: [
        ({"frequency": 0}, "Scene.frequency: 0 Hz; must be finite and > 0"),
        ({"frequency": FAR}, "Scene.frequency: 1e+200 Hz; must be in 0.001 to 1e+12"),
        ({"frequency": 1 / FAR}, "Scene.frequency: 1e-200 Hz; must be in 0.001 to 1e+12"),
        ({"name": ""}, "Scene.name: ''; must be text of at least one character"),
        ({"control_points": (80e-3, 50e-3, 50e-3)}, "Scene.control_points: shape (3,); must be (P, 3) with"),
        ({"control_points": [(0.08, 0.05, 0.05)] * 2}, "Scene.control_points: points 0 and 1 coincide"),
        ({"control_points": [[FAR, 0, 0]]}, "control_points: (1e+200, 0.0, 0.0) m; every coordinate must be"),
        (
            {"array": grid(shape=(1, 1)), "control_points": [(1e-3, 50e-3, 50e-3)]},
            "Scene.control_points[0]: (0.001, 0.05, 0.05) m; lies on transducer 0",
        ),
        ({"obstacles": [box(), box(center=(0.0, 35e-3, 35e-3))]}, "m; lies in or on obstacle 1"),
        (
            {"array": grid(radius=5e-3), "obstacles": [box(center=(0.0, 26e-3, 35e-3))]},
            "Scene.array.nodes[0, ",
        ),
        (
            {"array": grid(radius=5e-3, normal=(0, 1, 0)), "domain": ((-15e-3, 0, 0), (0.1, 0.1, 0.1))},
            "Scene.array disc's lower edge[0]: (-0.019, 0.05, 0.03",
        ),
        ({"array": grid(pitch=FAR)}, "Scene.array.positions: (0.001, -1.5e+200, -1.5e+200) m; every"),
        ({"medium": replace(AIR, absorption=400.0)}, "Scene.medium.absorption: 400.0 dB/m; must be at most"),
        ({"obstacles": [box(center=(80e-3, 50e-3, 80e-3))]}, "points[1]: (0.08, 0.05, 0.08) m; lies in or o"),
        ({"obstacles": [box()], "control_points": [(46e-3, 50e-3, 50e-3)]}, "must be outside it"),
        ({"obstacles": [box(center=(FAR, 0, 0), size=(FAR,) * 3)]}, "corner: (5e+199, -5e+199, -5e+199) m;"),
        ({"obstacles": [box(center=(1e308, 0, 0), size=(1.7e308,) * 3)]}, "Scene.obstacles[0] corner: ("),
        ({"obstacles": [box(center=(41e-3, 50e-3, 105e-3))], "domain": ROOM}, "must be at least partly in"),
        ({"domain": ((0, 0, 0), (0.1, 0.1, 0))}, "Scene.domain: ((0.0, 0.0, 0.0), (0.1, 0.1, 0.0)) m; lower"),
        ({"domain": (1, 1, 1)}, "Scene.domain: (1, 1, 1); must be two corners"),
        ({"domain": ((-FAR,) * 3, (FAR,) * 3)}, "Scene.domain: (-1e+200, -1e+200, -1e+200) m; every"),
        ({"domain": ((0, 0, 0), (0.1, 0.1, 0.07))}, "control_points[1]: (0.08, 0.05, 0.08) m; must be insi"),
        ({"domain": ((0.01, 0, 0), (0.1, 0.1, 0.1))}, "positions[0]: (0.001, 0.035, 0.035) m; must be insid"),
        ({"domain": ROOM, "observation_plane": plane(0.1, 0.2)}, "plane corner[0]: (0.08, 0.0, -0.05)"),
        ({"observation_plane": plane(FAR, 0.1)}, "Scene.observation_plane corner: (0.08, "),
    ],
    "make_propagator": [({"spacing": 1 / FAR}, "spacing: 1e-200 m; must be at least 1.7e-05 m")],
}


@pytest.mark.parametrize(
    ("call", "changes", "message"), [(call, *row) for call, rows in OUT_OF_RANGE.items() for row in rows]
)
def test_a_value_out_of_range_is_named_with_the_range(call, changes, message, tmp_path):
    arguments = CALLS[call].arguments(tmp_path) if isinstance(call, str) else {}
    function = CALLS[call].bound(tmp_path) if isinstance(call, str) else call
    error = refusal(function, arguments | changes)
    assert isinstance(error, ValueError)
    assert message in str(error)
    assert "\n" not in str(error)


def test_a_file_without_a_mask_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "two.npz"
    np.savez(path, a=np.ones(1), b=np.ones(1))
    with pytest.raises(ValueError, match="holds 2 arrays, must hold a single one"):
        at.VoxelMask.load(path, 1e-3, rigid=True)
    path.write_bytes(b"PK\x03\x04 and then nothing")
    with pytest.raises(ValueError, match=r"VoxelMask\.path: .* must be a \.npy or \.npz file"):
        at.VoxelMask.load(path, 1e-3, rigid=True)


@pytest.mark.parametrize("kind", [deque, UserList, tuple])
def test_a_list_of_any_class_is_a_list(kind: Callable[[list[float]], Any]) -> None:
    assert at.circle_points(kind([80e-3, 50e-3, 50e-3]), 30e-3, 4, (1, 0, 0)).equal(FOCI)


@pytest.mark.filterwarnings("ignore::autdtorch.ScaleWarning")
@pytest.mark.parametrize("method", ["box", "full"])
def test_the_largest_scene_is_refused_for_its_memory(method: Any) -> None:
    far = 1e6
    wall = box(center=(0, 0, far / 2), size=(far, far, far - 2))
    wide = scene(domain=((-far,) * 3, (far,) * 3), obstacles=[wall])
    with pytest.raises(ValueError, match=r"^spacing: 0\.001 m; (needs about|gives) "):
        at.make_propagator(wide, method)


def test_errors_of_a_generator_are_its_own() -> None:
    array, air = at.TransducerArray([(0, 0, 0)], (0, 0, 1)), at.Medium(1.2, 343.0)
    spheres = (at.Sphere((0, 0, 0.05), radius, rigid=True) for radius in (1e-3, -1e-3))
    with pytest.raises(ValueError, match=r"^Sphere\.radius: -0\.001"):
        at.Scene(array, air, 40e3, [(0, 0, 0.1)], spheres)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("load", "name"),
    [
        (at.load_scene, "lab.yaml"),
        (at.load_results, "study.h5"),
        (at.load_array, "array.csv"),
        (at.load_drive, "drive.npz"),
        (at.load_sequence, "ring.csv"),
        (at.load_drive, "drive.xml.gz"),
    ],
)
def test_a_missing_file_or_a_folder_is_named_with_what_to_do(load, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=f"^{name}: there is no such file; .* from {tmp_path}$"):
        load(name)
    (tmp_path / name / "results.h5").mkdir(parents=True)
    with pytest.raises(IsADirectoryError, match=r"^[\w./]*: a folder; must be a file$"):
        load(name)
