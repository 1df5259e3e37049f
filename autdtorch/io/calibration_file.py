"""The file of a calibration: plain NumPy arrays and a line of JSON, so that reading it runs no code.

The array "header" is JSON with all that is no tensor, and with a digest of the other arrays. The names of
these are the fields that they hold; those of "scene/..." are the bytes of the files that `save_scene` writes.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from autdtorch.io.scene_file import load_scene, save_scene
from autdtorch.methods.calibration.calibration import Calibration, HeldBack
from autdtorch.methods.calibration.fit import CalibrationFit, CalibrationStart, Changes, LinearChanges
from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.methods.matrix_posterior import MatrixPosterior, MatrixPrior
from autdtorch.methods.prior import Prior
from autdtorch.objectives.readings import Readings
from autdtorch.propagators import Propagator, make_propagator
from autdtorch.propagators.free_space import FreeSpacePropagator
from autdtorch.propagators.scene_changes import SceneChanges
from autdtorch.propagators.simulated import SimulatedPropagator
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import path_of, read_arrays, write_arrays
from autdtorch.utils.validation import invalid, require_kind, within

_VERSION = 1
_HEADER, _SCENE = "header", "scene/"
_SCENE_FILE = "scene.yaml"
_SETTINGS = ("method", "spacing", "tolerance", "max_periods", "time_step")  # of a plan, with its dtype
_OF_READINGS = ("drives", "pressure", "points", "phase", "deviation")
_OF_PRIOR = ("rows", "spread", "widths", "changes")
_OF_POSTERIOR = ("factors", "entries", "variance")
_OF_MAGNITUDES = ("value", "limit", "phase", "deviation")
_OF_PREDICTIONS, _OF_ERRORS = ("predicted", "simulated"), ("error", "before", "coverage", "readings")
_NUMBERS = ("gain", "phase", "rest")  # of a prior


def save_calibration(path: str | os.PathLike[str], calibration: Calibration) -> None:
    """Write a calibration to a .npz file, with its readings, its scene and the settings of the simulation.

    Args:
        path: of the file, which is replaced.
        calibration: of a propagator that `make_propagator` made, or of a transfer matrix.

    Raises:
        ValueError: another suffix, a propagator of a user's class, or an obstacle of one.
        OSError: the file cannot be written.
    """
    path = path_of("path", path, suffixes=(".npz",))
    require_kind("calibration", calibration, Calibration)
    simulation, fit, held = calibration.simulation, calibration.fit, calibration.held_back
    prior = calibration.settings
    tensors = {
        "simulated": calibration.simulated,
        "widths": simulation.widths,
        "points": simulation.points,
        **_parts("readings", calibration.readings, _OF_READINGS),
        **_parts("prior", fit.posterior.prior, _OF_PRIOR),
        **_parts("posterior", fit.posterior, _OF_POSTERIOR),
        **_parts("read", fit.read, _OF_MAGNITUDES),
    }
    if held is not None:
        tensors |= _parts("held_back", held, _OF_PREDICTIONS)
    if isinstance(prior.variants, torch.Tensor):
        tensors["variants"] = prior.variants
    if isinstance(simulation.changes, LinearChanges):
        tensors["steps"] = simulation.changes.steps
    arrays: dict[str, AnyArray] = {
        name: tensor.detach().resolve_conj().numpy() for name, tensor in tensors.items() if tensor is not None
    }
    if simulation.scene is not None:
        arrays |= _scene_files(simulation.scene)
    header = {
        "version": _VERSION,
        "propagator": _settings_of(simulation.propagator),
        "prior": {name: getattr(prior, name) for name in _NUMBERS},
        "variants": dict(prior.variants) if isinstance(prior.variants, Mapping) else None,
        "names": simulation.changes.names,
        "unit": fit.unit,
        "converged": fit.converged,
        "held_back": None if held is None else {name: getattr(held, name) for name in _OF_ERRORS},
        "doubts": calibration.doubts,
        "digest": _digest(arrays),
    }
    write_arrays(path, arrays | {_HEADER: np.array(json.dumps(header))})


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration from a file of `save_calibration`.

    Predictions at the points of the readings take no simulation. For others, the propagator of the scene is
    made again with its settings, on the device that is there.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a file of another version, or one that is not as `save_calibration` wrote it.
    """
    path = path_of("path", path, suffixes=(".npz",))
    arrays = read_arrays(path)
    with within(os.fspath(path)):
        header = _checked_header(arrays)
        files = {name.removeprefix(_SCENE): arrays.pop(name) for name in [*arrays] if name.startswith(_SCENE)}
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        scene = _scene_of(files) if files else None
        propagator = None if scene is None else make_propagator(scene, **header["propagator"])
        points, names = tensors.get("points"), tuple(header["names"])
        if "steps" in tensors or propagator is None:
            changes: Changes = LinearChanges(tensors["simulated"], tensors["steps"], names)
        else:
            changes = SceneChanges(propagator, names, points)
        simulation = CalibrationStart(propagator, changes, tensors["widths"], points)
        readings = Readings(**_group("readings", tensors))
        prior = Prior(variants=header["variants"] or tensors.get("variants"), **header["prior"])
        matrix_prior = MatrixPrior(**_group("prior", tensors))
        posterior = MatrixPosterior(matrix_prior, **_group("posterior", tensors))
        fit = CalibrationFit(
            posterior,
            Magnitudes(**_group("read", tensors)),
            readings.drives,
            header["unit"],
            header["converged"],
        )
        held = None
        if header["held_back"] is not None:
            held = HeldBack(**header["held_back"], **_group("held_back", tensors))
        doubts = tuple(header["doubts"])
        return Calibration(simulation, tensors["simulated"], readings, prior, fit, held, doubts)


def _parts(group: str, value: object, names: tuple[str, ...]) -> dict[str, torch.Tensor | None]:
    return {f"{group}.{name}": getattr(value, name) for name in names}


def _group(group: str, tensors: Mapping[str, torch.Tensor]) -> dict[str, Any]:
    start = f"{group}."
    return {name.removeprefix(start): tensor for name, tensor in tensors.items() if name.startswith(start)}


def _settings_of(propagator: Propagator | None) -> dict[str, Any] | None:
    """Return the arguments of `make_propagator`, without device and kernel; None for a matrix alone."""
    if propagator is None:
        return None
    if isinstance(propagator, FreeSpacePropagator):
        return {"method": "free_space"}
    if not isinstance(propagator, TMatrixPropagator | SimulatedPropagator):
        accepted = "must be one that make_propagator makes; or calibrate its transfer matrix"
        raise invalid("calibration.simulation.propagator", type(propagator).__name__, accepted)
    plan = propagator.plan
    return {name: getattr(plan, name) for name in _SETTINGS} | {"dtype": str(plan.dtype).partition(".")[2]}


def _checked_header(arrays: dict[str, AnyArray]) -> dict[str, Any]:
    """Remove the header from the arrays, and return it after checking the others."""
    accepted = "must be as save_calibration wrote it"
    try:
        header: dict[str, Any] = json.loads(str(arrays.pop(_HEADER)))
        version, digest = header["version"], header["digest"]
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{_HEADER}: missing or damaged; {accepted}") from error
    if version != _VERSION:
        raise invalid(f"{_HEADER}: version", version, f"must be {_VERSION}, the one of this autdtorch")
    if digest != _digest(arrays):
        raise ValueError(f"arrays: missing or changed; {accepted}")
    return header


def _digest(arrays: Mapping[str, AnyArray]) -> str:
    parts = [part for name, array in sorted(arrays.items()) for part in (name, array.shape, array)]
    return digest_of(*parts)


def _scene_files(scene: Scene) -> dict[str, AnyArray]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_scene(folder / _SCENE_FILE, scene)
        contents = {f"{_SCENE}{path.name}": path.read_bytes() for path in sorted(folder.iterdir())}
    return {name: np.frombuffer(content, np.uint8) for name, content in contents.items()}


def _scene_of(files: Mapping[str, AnyArray]) -> Scene:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, content in files.items():
            if Path(file).name != file:
                raise invalid("scene", file, "must be files in one folder")
            (folder / file).write_bytes(content.tobytes())
        return load_scene(folder / _SCENE_FILE)
