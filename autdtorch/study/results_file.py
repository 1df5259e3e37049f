"""The file ``results.h5``: the results of the finished scenes of a study.

The file is plain HDF5, in which everything is checked when read. The SHA-256 of its content is in the block
that HDF5 leaves to the user at the start of a file.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import torch

import autdtorch
from autdtorch.io.goal_section import PAPERS_GOAL, load_goal, require_score
from autdtorch.objectives.kinds import GOALS
from autdtorch.objectives.metrics import FocusMetrics
from autdtorch.propagators import Run
from autdtorch.study.results import (
    MethodResult,
    Provenance,
    SceneResult,
    SceneSimulation,
    StudyResult,
    stored_numbers,
    stored_solution,
)
from autdtorch.utils.files import path_of, replace_file, require_file, require_name
from autdtorch.utils.validation import (
    boolean,
    complex_tensor,
    finite_number,
    integer_at_least,
    invalid,
    not_negative,
    positive,
    require_kind,
    require_one_of,
)

RESULTS_FILE = "results.h5"

_SIMULATION = ("method", "wavelength", "spacing", "tolerance", "matrix_seconds", "plane_seconds")
_RUN = ("periods", "remaining", "reached", "seconds")
_SOLUTION = ("drive", "pressure", "score", "evaluations", "history")
_METRICS = ("mean", "min", "std", "uniformity", "area")
_VERSION = "version_"  # prefix of the attributes with versions of packages
_USER_BLOCK = 512  # bytes, the fewest that HDF5 allows
_DAMAGE = (OSError, KeyError, ValueError, TypeError, AttributeError, OverflowError, RuntimeError)  # of h5py


def save_results(results: StudyResult, folder: Path) -> None:
    """Write the results of a study into a folder, which is made if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    content = io.BytesIO()  # on a full disk, HDF5 would raise no OSError but fail when it closes the file
    with h5py.File(content, "w", userblock_size=_USER_BLOCK) as file:
        for key in ("config", "seed", "source_digest", "date"):
            file.attrs[key] = getattr(results.provenance, key)
        for package, version in results.provenance.versions.items():
            file.attrs[f"{_VERSION}{package}"] = version
        scenes = file.create_group("scenes", track_order=True)
        for name, scene in results.scenes.items():
            _write_scene(scenes.create_group(name), scene)
    body = content.getvalue()[_USER_BLOCK:]
    replace_file(folder / RESULTS_FILE, _user_block(body) + body)


def load_results(path: str | os.PathLike[str]) -> StudyResult:
    """Read the results of a study.

    Args:
        path: the file, or the folder with `results.h5`.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, not a results file, or of another version.
        OSError: the file cannot be read.
    """
    path = path_of("path", path)
    if path.is_dir():
        path = path / RESULTS_FILE
    content = require_file(path).read_bytes()
    try:
        if content[:_USER_BLOCK] != _user_block(content[_USER_BLOCK:]):
            raise ValueError("its checksum is wrong")
        with h5py.File(io.BytesIO(content), "r") as file:
            scenes = {name: _read_scene(group) for name, group in _named(file, "scenes")}
            return StudyResult(_read_provenance(file.attrs), scenes)
    except _DAMAGE as error:
        accepted = f"must be a results file of autdtorch {autdtorch.__version__}"
        raise ValueError(f"{path}: {error}; {accepted}") from error


def _user_block(body: bytes) -> bytes:
    """Return the first block of the file: the SHA-256 of its HDF5 content, in hexadecimal."""
    return hashlib.sha256(body).hexdigest().encode().ljust(_USER_BLOCK, b"\0")


def _read_provenance(attributes: Any) -> Provenance:
    fields = {key: attributes[key] for key in ("config", "source_digest", "date")}
    versions = {key.removeprefix(_VERSION): attributes[key] for key in attributes if key.startswith(_VERSION)}
    seed = integer_at_least("seed", attributes["seed"], 0)
    return Provenance.from_fields({**fields, "seed": seed, "versions": versions})


def _write_scene(group: Any, scene: SceneResult) -> None:
    # A user's goal may have settings that JSON cannot hold.
    attributes: dict[str, Any] = {"goal": json.dumps(scene.goal, default=str), "unit": scene.unit}
    attributes |= {"obstacles": scene.obstacles, "bound": scene.bound, "of_pressures": scene.of_pressures}
    attributes |= {key: getattr(scene.simulation, key) for key in _SIMULATION}
    group.attrs.update({key: value for key, value in attributes.items() if value is not None})
    for key in _RUN:
        group[f"runs/{key}"] = [getattr(run, key) for run in scene.simulation.runs]
    group["transfer_matrix"] = scene.transfer_matrix.numpy()
    methods = group.create_group("methods", track_order=True)
    for name, method in scene.methods.items():
        _write_method(methods.create_group(name), method)


def _read_scene(group: Any) -> SceneResult:
    matrix = _complex_matrix(group, "transfer_matrix")
    points, transducers = matrix.shape
    of_pressures = boolean("of_pressures", group.attrs.get("of_pressures", True))
    goal, unit = _read_goal(group.attrs)
    bound = group.attrs["bound"]
    return SceneResult(
        integer_at_least("obstacles", group.attrs["obstacles"], 0),
        matrix,
        math.inf if bound == math.inf else finite_number("bound", bound, unit),
        _read_simulation(group),
        {
            name: _read_method(entry, points, transducers, of_pressures)
            for name, entry in _named(group, "methods")
        },
        goal,
        unit,
    )


def _read_goal(attributes: Any) -> tuple[dict[str, Any], str]:
    """Return the section of the goal, and the unit of its scores; files without are of the paper's goal."""
    if "goal" not in attributes:
        return PAPERS_GOAL.copy(), "Pa"
    goal, unit = json.loads(attributes["goal"]), attributes["unit"]
    require_kind("goal", goal, dict)
    require_score(goal["name"], unit)
    if goal["name"] in GOALS:
        load_goal("goal", goal)
    return goal, unit


def _read_simulation(group: Any) -> SceneSimulation:
    attributes, runs = group.attrs, _entry(group, "runs")
    columns = [_array(runs, key).tolist() for key in _RUN]
    method = attributes["method"].replace("operator", "tmatrix")  # a name of version 0.1
    require_one_of("method", method, ("free_space", "box", "full", "tmatrix"))
    return SceneSimulation(
        method,
        positive("wavelength", attributes["wavelength"], "m"),
        positive("spacing", attributes["spacing"], "m") if "spacing" in attributes else None,
        positive("tolerance", attributes["tolerance"]) if "tolerance" in attributes else None,
        tuple(_run(*row) for row in zip(*columns, strict=True)),
        not_negative("matrix_seconds", attributes["matrix_seconds"], "s"),
        not_negative("plane_seconds", attributes["plane_seconds"], "s"),
    )


def _run(periods: Any, remaining: Any, reached: Any, seconds: Any) -> Run:
    if not remaining >= 0:  # infinite if there was no estimate
        raise invalid("remaining", remaining, "must be >= 0")
    periods, reached = integer_at_least("periods", periods, 1), boolean("reached", reached)
    return Run(periods, float(remaining), reached, not_negative("seconds", seconds, "s"))


def _write_method(group: Any, method: MethodResult) -> None:
    group.attrs["shown_trial"] = method.shown_trial
    tensors = {key: getattr(method.solution, key) for key in _SOLUTION}
    if method.metrics is not None:
        tensors |= {key: getattr(method.metrics, key) for key in _METRICS}
    tensors |= {"seconds": method.seconds, "plane_pressure": method.plane_pressure}
    for key, tensor in tensors.items():
        if tensor is not None:
            group[key] = tensor.numpy()


def _read_method(group: Any, points: int, transducers: int, of_pressures: bool) -> MethodResult:
    solution = stored_solution({key: _array(group, key) for key in _SOLUTION}, transducers, points)
    trials = len(solution.score)
    shown = integer_at_least("shown_trial", group.attrs["shown_trial"], 0)
    if shown >= trials:
        raise invalid("shown_trial", shown, f"must be in 0 to {trials - 1}, one of the trials")
    metrics = None
    if of_pressures:
        area = _magnitudes(group, "area", trials) if "area" in group else None
        metrics = FocusMetrics(**{key: _magnitudes(group, key, trials) for key in _METRICS[:-1]}, area=area)
    plane = _complex_matrix(group, "plane_pressure") if "plane_pressure" in group else None
    return MethodResult(solution, metrics, _magnitudes(group, "seconds", trials), shown, plane)


def _complex_matrix(group: Any, key: str) -> torch.Tensor:
    matrix = complex_tensor(key, _array(group, key))
    if matrix.ndim != 2 or matrix.numel() == 0:
        raise ValueError(f"{key}: shape {tuple(matrix.shape)}; must have two axes, each of at least 1")
    return matrix


def _magnitudes(group: Any, key: str, trials: int) -> torch.Tensor:
    return stored_numbers(key, _array(group, key), trials)


def _array(group: Any, key: str) -> Any:
    """Return the numbers of a dataset, at most as many as the file can hold: nothing in it is compressed."""
    dataset = _entry(group, key)
    most = group.file.id.get_filesize()
    if dataset.nbytes > most:
        raise invalid(key, dataset.nbytes, f"must be at most {most}, the size of the file", "bytes")
    if dataset.external or dataset.is_virtual:
        raise ValueError(f"{key}: kept in another file; must be in this one")
    return dataset[()]


def _named(group: Any, field: str) -> Iterator[tuple[str, Any]]:
    """Yield groups with their names, which become part of file names."""
    entries = _entry(group, field)
    for name in entries:
        require_name(field, name)
        yield name, _entry(entries, name)


def _entry(group: Any, key: str) -> Any:
    """Return an entry of a group; links are refused, as they may lead to another file."""
    if isinstance(group.get(key, getlink=True), h5py.SoftLink | h5py.ExternalLink):
        raise ValueError(f"{key}: a link; must be in the file itself")
    return group[key]
