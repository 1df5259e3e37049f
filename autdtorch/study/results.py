"""What a study leaves on disk, and how it is read back.

``results.h5`` holds everything of the finished scenes, ``provenance.json`` where it comes from. Both are
written beside their place and then renamed, so that what is there is always complete. Both have a checksum:
the second as a line of `json_lines`, the first in the block that HDF5 leaves to the user in front of a file.
"""

from __future__ import annotations

import hashlib
import io
import os
import platform
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

import autdtorch
from autdtorch.methods import label_of
from autdtorch.methods.base import NEAR_TIE, Solution
from autdtorch.objectives.metrics import FocusMetrics
from autdtorch.objectives.simulated import validate_drives
from autdtorch.propagators import Run
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import replace_file
from autdtorch.utils.html import html_table
from autdtorch.utils.json_lines import line_of, row_of
from autdtorch.utils.provenance import package_versions, source_digest
from autdtorch.utils.validation import (
    boolean,
    complex_tensor,
    integer_at_least,
    invalid,
    not_negative,
    path_of,
    positive,
    real_tensor,
    require_name,
    require_one_of,
)

RESULTS_FILE = "results.h5"
PROVENANCE_FILE = "provenance.json"

_SIMULATED_BY = ("free_space", "box", "full")
_SOLUTION = ("drive", "pressure", "score", "evaluations", "history")
_METRICS = ("mean", "min", "std", "uniformity", "area")
_PROVENANCE = {"config": str, "seed": int, "versions": dict, "source_digest": str, "date": str}
_USER_BLOCK = 512  # bytes, the fewest that HDF5 allows
_DAMAGE = (OSError, KeyError, ValueError, TypeError, AttributeError, OverflowError, RuntimeError)  # of h5py


@dataclass(frozen=True)
class Provenance:
    """Where results come from.

    Attributes:
        config: all settings, as YAML text.
        seed: of the random choices.
        versions: of autdtorch, Python, the packages that compute, and the platform.
        source_digest: SHA-256 of the package's source.
        date: when the study was begun, UTC, ISO 8601.
    """

    config: str
    seed: int
    versions: dict[str, str]
    source_digest: str
    date: str

    @property
    def origin(self) -> str:
        """The SHA-256 of all but the date: equal for studies that lead to the same results."""
        return digest_of(self.config, self.seed, sorted(self.versions.items()), self.source_digest)

    def same_origin(self, other: Provenance) -> bool:
        """Return whether both lead to the same results: all but the date is equal."""
        return self.origin == other.origin

    def __repr__(self) -> str:
        """Version, seed and date, without the settings."""
        return f"Provenance(autdtorch {self.versions.get('autdtorch')}, seed {self.seed}, begun {self.date})"


@dataclass(frozen=True)
class Simulation:
    """How the field of a scene was computed.

    Attributes:
        method: "free_space" (exact), "box" or "full" (FDTD).
        wavelength: in the medium [m].
        spacing: edge of a cell [m]; None in free space, as is `tolerance`.
        tolerance: relative distance to the steady state at which a run ends.
        runs: every simulation that was made; none for matrices that were kept on disk.
        matrix_seconds: time the transfer matrix of the control points took.
        plane_seconds: time the observation plane took, for all trials of all methods together.
    """

    method: str
    wavelength: float
    spacing: float | None
    tolerance: float | None
    runs: tuple[Run, ...]
    matrix_seconds: float
    plane_seconds: float

    def __repr__(self) -> str:
        """Method, settings and times, with units."""
        grid = "" if self.spacing is None else f"spacing {1e3 * self.spacing:.4g} mm, {len(self.runs)} runs, "
        return (
            f"Simulation({self.method}, {grid}matrix {self.matrix_seconds:.2g} s, "
            f"plane {self.plane_seconds:.2g} s)"
        )


@dataclass(frozen=True, eq=False)
class MethodResult:
    """What one method found in one scene.

    Attributes:
        solution: drives of the T trials, with pressures, scores, evaluations and history.
        metrics: figures of merit (T,).
        seconds: each trial's share of the time they took (T,), float64.
        shown_trial: the trial of median score, for pictures.
        plane_pressure: of the shown trial on the observation plane (Nu, Nv), complex128 [Pa], or None where
            the scene has no such plane.
    """

    solution: Solution
    metrics: FocusMetrics
    seconds: torch.Tensor
    shown_trial: int
    plane_pressure: torch.Tensor | None

    @property
    def trials(self) -> int:
        """Number of trials T."""
        return len(self.solution.score)

    def __repr__(self) -> str:
        """What was reached, with units."""
        return f"MethodResult({self.solution!r}, {self.seconds.mean():.2g} s a trial)"


@dataclass(frozen=True, eq=False)
class SceneResult:
    """What was found in one scene.

    Attributes:
        obstacles: number of obstacles.
        transfer_matrix: of the control points (P, M), complex128 [Pa].
        bound: certified upper bound on the weakest focus [Pa].
        simulation: how the field was computed.
        methods: by name, in the order they ran.
    """

    obstacles: int
    transfer_matrix: torch.Tensor
    bound: float
    simulation: Simulation
    methods: dict[str, MethodResult]

    def __repr__(self) -> str:
        """Counts, bound and methods, with units."""
        points, transducers = self.transfer_matrix.shape
        return (
            f"SceneResult({self.obstacles} obstacles, {transducers} transducers, {points} control points, "
            f"bound {self.bound:.4g} Pa, methods {', '.join(self.methods)})"
        )


@dataclass(frozen=True, eq=False)
class StudyResult:
    """What a study found.

    Attributes:
        provenance: where it comes from.
        scenes: by name, in the order they ran; while a study runs, those that are finished.
    """

    provenance: Provenance
    scenes: dict[str, SceneResult]

    def __repr__(self) -> str:
        """The methods of each scene."""
        scenes = "; ".join(f"{name}: {', '.join(scene.methods)}" for name, scene in self.scenes.items())
        return f"StudyResult({scenes})"

    def _repr_html_(self) -> str:
        """For Jupyter: the summary."""
        return html_table(f"Study of {self.provenance.date}", summary_rows(self))


def median_trial(score: torch.Tensor) -> int:
    """The trial of median score, of two middle ones the lower; `score` is (T,)."""
    return int(score.argsort(stable=True)[(len(score) - 1) // 2])


def provenance_now(config: str, seed: int) -> Provenance:
    """Provenance of a study that begins now, in this process and with this source.

    Args:
        config: all settings, as YAML text.
        seed: of the random choices.
    """
    versions = {"autdtorch": autdtorch.__version__, "python": platform.python_version()}
    versions |= package_versions()
    versions["platform"] = platform.platform()
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return Provenance(config, seed, versions, source_digest(), date)


def summary_rows(results: StudyResult) -> list[list[str]]:
    """A table of the results, its head first: mean over the trials, and ± their standard deviation."""
    head = ["scene", "method", "trials", "mean [Pa]", "weakest [Pa]", "std [Pa]", "area [mm²]"]
    rows = [[*head, "evaluations"]]
    for scene_name, scene in results.scenes.items():
        for name, method in scene.methods.items():
            metrics = method.metrics
            area = "none" if metrics.area is None else _over_trials(1e6 * metrics.area, ".0f")
            pressures = (metrics.mean, metrics.min, metrics.std)
            numbers = [str(method.trials), *(_over_trials(values, ".2f") for values in pressures), area]
            evaluations = f"{method.solution.evaluations.double().mean():.0f}"
            rows.append([scene_name, label_of(name), *numbers, evaluations])
    return rows


def save_results(results: StudyResult, folder: str | os.PathLike[str]) -> None:
    """Write the files of a study into a folder, which is made if need be.

    Raises:
        OSError: the folder cannot be made or written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    content = io.BytesIO()  # HDF5 would not say that a disk is full, but fail when it closes the file
    with h5py.File(content, "w", userblock_size=_USER_BLOCK) as file:
        _write_provenance(file, results.provenance)
        scenes = file.create_group("scenes", track_order=True)
        for name, scene in results.scenes.items():
            _write_scene(scenes.create_group(name), scene)
    body = content.getvalue()[_USER_BLOCK:]
    replace_file(folder / RESULTS_FILE, _user_block(body) + body)


def save_provenance(provenance: Provenance, folder: str | os.PathLike[str]) -> None:
    """Write where the files of a study come from into its folder.

    Raises:
        OSError: the folder cannot be written.
    """
    replace_file(Path(folder) / PROVENANCE_FILE, line_of(asdict(provenance)) + b"\n")


def load_provenance(folder: str | os.PathLike[str]) -> Provenance:
    """Read what `save_provenance` wrote.

    Raises:
        ValueError: the file is damaged, or of another version.
        OSError: it cannot be read; a `FileNotFoundError` where there is none.
    """
    path = Path(folder) / PROVENANCE_FILE
    content = path.read_bytes()
    try:
        return _provenance(row_of(content.removesuffix(b"\n")))
    except (ValueError, RecursionError) as error:
        accepted = f"must be a provenance file of autdtorch {autdtorch.__version__}"
        raise ValueError(f"{path}: {error}; {accepted}") from error


def load_results(path: str | os.PathLike[str]) -> StudyResult:
    """Read the results of a study.

    Args:
        path: the file, or the folder that holds `results.h5`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, no results file, or one of another version.
        OSError: it cannot be read.
    """
    path = path_of("path", path)
    if path.is_dir():
        path = path / RESULTS_FILE
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such results file")
    content = path.read_bytes()
    try:
        if content[:_USER_BLOCK] != _user_block(content[_USER_BLOCK:]):
            raise ValueError("its checksum is wrong")
        with h5py.File(io.BytesIO(content), "r") as file:
            scenes = {name: _read_scene(group) for name, group in _named(file, "scenes")}
            return StudyResult(_read_provenance(file), scenes)
    except _DAMAGE as error:
        accepted = f"must be a results file of autdtorch {autdtorch.__version__}"
        raise ValueError(f"{path}: {error}; {accepted}") from error


def _user_block(body: bytes) -> bytes:
    """Return the block that goes before HDF5 content: its SHA-256, in hexadecimal."""
    return hashlib.sha256(body).hexdigest().encode().ljust(_USER_BLOCK, b"\0")


def _over_trials(values: torch.Tensor, form: str) -> str:
    mean = f"{values.mean():{form}}"
    return mean if len(values) == 1 else f"{mean} ± {values.std():{form}}"


def _provenance(row: dict[str, Any]) -> Provenance:
    if {key: type(value) for key, value in row.items()} != _PROVENANCE:
        raise ValueError(f"fields {', '.join(row)} that are not as they were written")
    return Provenance(**row)


def _write_provenance(file: Any, provenance: Provenance) -> None:
    for key in ("config", "seed", "source_digest", "date"):
        file.attrs[key] = getattr(provenance, key)
    for package, version in provenance.versions.items():
        file.attrs[f"version_{package}"] = version


def _read_provenance(file: Any) -> Provenance:
    prefix = "version_"
    values = file.attrs
    row = {key: values[key] for key in ("config", "source_digest", "date")}
    versions = {key.removeprefix(prefix): values[key] for key in values if key.startswith(prefix)}
    return _provenance({**row, "seed": integer_at_least("seed", values["seed"], 0), "versions": versions})


def _write_scene(group: Any, scene: SceneResult) -> None:
    simulation = scene.simulation
    group.attrs["obstacles"] = scene.obstacles
    group.attrs["bound"] = scene.bound
    for key in ("method", "wavelength", "spacing", "tolerance", "matrix_seconds", "plane_seconds"):
        if (value := getattr(simulation, key)) is not None:
            group.attrs[key] = value
    for key in ("periods", "remaining", "reached", "seconds"):
        group[f"runs/{key}"] = [getattr(run, key) for run in simulation.runs]
    group["transfer_matrix"] = scene.transfer_matrix.numpy()
    methods = group.create_group("methods", track_order=True)
    for name, method in scene.methods.items():
        _write_method(methods.create_group(name), method)


def _named(group: Any, field: str) -> Iterator[tuple[str, Any]]:
    """Groups and their names, which become part of the names of files."""
    entries = _entry(group, field)
    for name in entries:
        require_name(field, name)
        yield name, _entry(entries, name)


def _read_scene(group: Any) -> SceneResult:
    attributes = group.attrs
    matrix = complex_tensor("transfer_matrix", _array(group, "transfer_matrix"))
    if matrix.ndim != 2 or matrix.numel() == 0:
        raise ValueError(f"transfer_matrix: shape {tuple(matrix.shape)}; must be (P, M) with P, M >= 1")
    points, transducers = matrix.shape
    methods = {name: _read_method(entry, points, transducers) for name, entry in _named(group, "methods")}
    return SceneResult(
        integer_at_least("obstacles", attributes["obstacles"], 0),
        matrix,
        not_negative("bound", attributes["bound"], "Pa"),
        _read_simulation(group),
        methods,
    )


def _read_simulation(group: Any) -> Simulation:
    attributes, runs = group.attrs, _entry(group, "runs")
    columns = [_array(runs, key).tolist() for key in ("periods", "remaining", "reached", "seconds")]
    require_one_of("method", attributes["method"], _SIMULATED_BY)
    return Simulation(
        attributes["method"],
        positive("wavelength", attributes["wavelength"], "m"),
        positive("spacing", attributes["spacing"], "m") if "spacing" in attributes else None,
        positive("tolerance", attributes["tolerance"]) if "tolerance" in attributes else None,
        tuple(_run(*row) for row in zip(*columns, strict=True)),
        not_negative("matrix_seconds", attributes["matrix_seconds"], "s"),
        not_negative("plane_seconds", attributes["plane_seconds"], "s"),
    )


def _run(periods: Any, remaining: Any, reached: Any, seconds: Any) -> Run:
    if not remaining >= 0:  # infinite where it could not be told
        raise invalid("remaining", remaining, "must be >= 0")
    return Run(
        integer_at_least("periods", periods, 1),
        float(remaining),
        boolean("reached", reached),
        not_negative("seconds", seconds, "s"),
    )


def _write_method(group: Any, method: MethodResult) -> None:
    group.attrs["shown_trial"] = method.shown_trial
    tensors = {key: getattr(method.solution, key) for key in _SOLUTION}
    tensors |= {key: getattr(method.metrics, key) for key in _METRICS}
    tensors |= {"seconds": method.seconds, "plane_pressure": method.plane_pressure}
    for key, tensor in tensors.items():
        if tensor is not None:
            group[key] = tensor.numpy()


def _read_method(group: Any, points: int, transducers: int) -> MethodResult:
    solution = _read_solution(group, points, transducers)
    trials = (len(solution.score),)
    shown = integer_at_least("shown_trial", group.attrs["shown_trial"], 0)
    if shown >= trials[0]:
        raise invalid("shown_trial", shown, f"must be one of {trials[0]} trials, counted from 0")
    mean, least, std, uniformity = (_magnitudes(group, key, trials) for key in _METRICS[:-1])
    area = _magnitudes(group, "area", trials) if "area" in group else None
    plane = None
    if "plane_pressure" in group:
        plane = complex_tensor("plane_pressure", _array(group, "plane_pressure"))
        if plane.ndim != 2 or plane.numel() == 0:
            raise ValueError(f"plane_pressure: shape {tuple(plane.shape)}; must be (Nu, Nv), none of them 0")
    metrics = FocusMetrics(mean, least, std, uniformity, area)
    return MethodResult(solution, metrics, _magnitudes(group, "seconds", trials), shown, plane)


def _read_solution(group: Any, points: int, transducers: int) -> Solution:
    """The solution of a method, after checking it as `TrialFile` does that of each trial."""
    drive = validate_drives(torch.from_numpy(_array(group, "drive")), transducers)
    trials = len(drive)
    evaluations = _array(group, "evaluations")
    if evaluations.shape != (trials,) or evaluations.dtype != np.int64 or evaluations.min() < 1:
        raise invalid("evaluations", evaluations, f"must be {trials} integers >= 1")
    most = int(evaluations.max())
    history = real_tensor("history", _array(group, "history"))
    shape = tuple(history.shape)
    if history.ndim != 2 or shape[0] != trials or shape[1] < most or (history.diff() < 0).any():
        accepted = f"must be ({trials}, {most}) or longer, no number below the one before"
        raise ValueError(f"history: shape {shape}; {accepted}")
    score = _numbers(group, "score", (trials,))
    best = history[:, -1]
    if (score > best + NEAR_TIE * best.abs()).any():
        raise invalid("score", score, f"must be at most {best.tolist()}, the best of the history")
    pressure = _magnitudes(group, "pressure", (trials, points))
    return Solution(drive, pressure, score, torch.from_numpy(evaluations), history)


def _magnitudes(group: Any, key: str, shape: tuple[int, ...]) -> torch.Tensor:
    numbers = _numbers(group, key, shape)
    if numbers.min() < 0:
        raise invalid(key, numbers, "every number must be >= 0")
    return numbers


def _numbers(group: Any, key: str, shape: tuple[int, ...]) -> torch.Tensor:
    numbers = torch.from_numpy(_array(group, key))
    real_tensor(key, numbers)
    if numbers.shape != shape or not numbers.is_floating_point():
        raise ValueError(f"{key}: {numbers.dtype} of shape {tuple(numbers.shape)}; must be floats {shape}")
    return numbers  # of the precision they were written in


def _array(group: Any, key: str) -> Any:
    """The numbers of a dataset, which cannot be more than the file holds: nothing in it is compressed."""
    dataset = _entry(group, key)
    most = group.file.id.get_filesize()
    if dataset.nbytes > most:
        raise invalid(key, dataset.nbytes, f"must be at most {most}, as many as the file has", "bytes")
    if dataset.external or dataset.is_virtual:
        raise ValueError(f"{key}: kept in another file; must be in this one")
    return dataset[()]


def _entry(group: Any, key: str) -> Any:
    """What a group itself has under a name: a link might lead to another file."""
    if isinstance(group.get(key, getlink=True), h5py.SoftLink | h5py.ExternalLink):
        raise ValueError(f"{key}: a link; must be in the file itself")
    return group[key]
