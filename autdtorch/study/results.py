"""Results of a study: classes for the study, its scenes, methods and simulations, and their summary table."""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

import autdtorch
from autdtorch.io.goal_section import PAPERS_GOAL, goal_label
from autdtorch.methods.base import NEAR_TIE
from autdtorch.methods.catalogue import label_of
from autdtorch.methods.solution import Solution
from autdtorch.objectives.metrics import FocusMetrics
from autdtorch.objectives.objective import validate_drives
from autdtorch.propagators import Run
from autdtorch.utils.digest import digest_of, package_versions, source_digest
from autdtorch.utils.files import line_of, replace_file, row_of
from autdtorch.utils.text import counted, decimals_of, html_table, in_percent
from autdtorch.utils.units import prefixed
from autdtorch.utils.validation import invalid, real_tensor

PROVENANCE_FILE = "provenance.json"

_NEWTONS = "N", "N/m"  # units that are shown with a prefix
_TYPES = {"config": str, "seed": int, "versions": dict, "source_digest": str, "date": str}


@dataclass(frozen=True)
class Provenance:
    """Everything that the results of a study depend on.

    Attributes:
        config: all settings, as YAML text.
        seed: of the random choices.
        versions: of autdtorch, Python, the numerical packages and the platform.
        source_digest: SHA-256 of the package's source.
        date: start of the study, UTC, ISO 8601.
    """

    config: str
    seed: int
    versions: dict[str, str]
    source_digest: str
    date: str

    @property
    def origin(self) -> str:
        """SHA-256 of all fields except the date: equal for studies with equal results."""
        return digest_of(self.config, self.seed, sorted(self.versions.items()), self.source_digest)

    def __repr__(self) -> str:
        return f"Provenance(autdtorch {self.versions.get('autdtorch')}, seed {self.seed}, begun {self.date})"

    @classmethod
    def from_fields(cls, fields: dict[str, Any]) -> Provenance:
        """Build from the fields read from a file, after checking their names and types."""
        if {key: type(value) for key, value in fields.items()} != _TYPES:
            accepted = ", ".join(f"{key} ({kind.__name__})" for key, kind in _TYPES.items())
            raise ValueError(f"fields {', '.join(fields)}; must be {accepted}")
        return cls(**fields)


def provenance_now(config: str, seed: int) -> Provenance:
    """Return the provenance of a study that starts now, with the source and packages of this process."""
    versions = {"autdtorch": autdtorch.__version__, "python": platform.python_version()}
    versions |= package_versions("botorch", "gpytorch") | {"platform": platform.platform()}
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return Provenance(config, seed, versions, source_digest(), date)


def save_provenance(provenance: Provenance, folder: Path) -> None:
    """Write the provenance of a study into its folder, with a checksum."""
    replace_file(folder / PROVENANCE_FILE, line_of(asdict(provenance)) + b"\n")


def load_provenance(folder: Path) -> Provenance:
    """Read the provenance that `save_provenance` wrote; refuse a damaged file or one of another version."""
    path = folder / PROVENANCE_FILE
    content = path.read_bytes()
    try:
        return Provenance.from_fields(row_of(content.removesuffix(b"\n")))
    except (ValueError, RecursionError) as error:
        accepted = f"must be a provenance file of autdtorch {autdtorch.__version__}"
        raise ValueError(f"{path}: {error}; {accepted}") from error


@dataclass(frozen=True)
class SceneSimulation:
    """The simulation of the field of one scene.

    Attributes:
        method: "free_space" (exact), "box" or "full" (FDTD), or "tmatrix".
        wavelength: in the medium [m].
        spacing: edge of a cell [m]; None in free space.
        tolerance: relative distance from the steady state at which a run ends; None in free space.
        runs: all FDTD runs; empty if the matrices came from the cache.
        matrix_seconds: time for the transfer matrix of the control points.
        plane_seconds: time for the observation plane, all trials of all methods together.
    """

    method: str
    wavelength: float
    spacing: float | None
    tolerance: float | None
    runs: tuple[Run, ...]
    matrix_seconds: float
    plane_seconds: float

    def __repr__(self) -> str:
        grid = (
            ""
            if self.spacing is None
            else f"spacing {1e3 * self.spacing:.4g} mm, {counted(len(self.runs), 'run')}, "
        )
        times = f"matrix {self.matrix_seconds:.2g} s, plane {self.plane_seconds:.2g} s"
        return f"SceneSimulation({self.method}, {grid}{times})"


@dataclass(frozen=True, eq=False)
class MethodResult:
    """The result of one method in one scene.

    Attributes:
        solution: drives of the T trials, with pressures, scores, evaluations and history.
        metrics: figures of merit (T,); None where the goal is a force.
        seconds: run time of each trial (T,), float64; trials that ran together have equal shares.
        shown_trial: the trial of median score, for pictures.
        plane_pressure: pressure of the shown trial on the observation plane (Nu, Nv), complex128 [Pa]; None
            if the scene has no such plane.
    """

    solution: Solution
    metrics: FocusMetrics | None
    seconds: torch.Tensor
    shown_trial: int
    plane_pressure: torch.Tensor | None

    @property
    def trials(self) -> int:
        """Number of trials T."""
        return len(self.solution.score)

    def of_foci(self, name: str) -> torch.Tensor | None:
        """Return a figure of merit (T,) of foci by name, such as "mean", if it is known."""
        values: torch.Tensor | None = getattr(self.metrics, name, None)
        return values

    def __repr__(self) -> str:
        return f"MethodResult({self.solution!r}, {self.seconds.mean():.2g} s a trial)"


@dataclass(frozen=True, eq=False)
class SceneResult:
    """The results of all methods in one scene.

    Attributes:
        obstacles: number of obstacles.
        transfer_matrix: of the control points (P, M), complex128 [Pa]; of a `ForceObjective` for a force.
        bound: certified upper bound on the score; infinite if none is known.
        simulation: the simulation of the field.
        methods: results by method name, in the order of the runs.
        goal: name and settings of the goal that the methods maximised.
        unit: of the scores, "" for numbers.
    """

    obstacles: int
    transfer_matrix: torch.Tensor
    bound: float
    simulation: SceneSimulation
    methods: dict[str, MethodResult]
    goal: Mapping[str, Any] = field(default_factory=PAPERS_GOAL.copy)
    unit: str = "Pa"

    @property
    def of_pressures(self) -> bool:
        """False where the goal is a force."""
        return any(method.metrics is not None for method in self.methods.values())

    @property
    def score_label(self) -> str:
        """Name and unit of the scores, such as "weakest focus [Pa]"."""
        return goal_label(self.goal, self.unit)

    def in_unit(self, score: object) -> str:
        """Return a score, or its text, with its unit."""
        return f"{score} {self.unit}".rstrip()

    def __repr__(self) -> str:
        points, transducers = self.transfer_matrix.shape
        return (
            f"SceneResult({counted(self.obstacles, 'obstacle')}, {counted(transducers, 'transducer')}, "
            f"{counted(points, 'control point')}, "
            f"goal {self.goal['name']}, bound {self.in_unit(f'{self.bound:.4g}')}, "
            f"methods {', '.join(self.methods)})"
        )


@dataclass(frozen=True, eq=False)
class StudyResult:
    """The results of a study.

    Attributes:
        provenance: settings, seed, versions and source of the study.
        scenes: results by scene name, in the order of the runs; of a running study, the finished scenes.
    """

    provenance: Provenance
    scenes: dict[str, SceneResult]

    def __repr__(self) -> str:
        scenes = "; ".join(f"{name}: {', '.join(scene.methods)}" for name, scene in self.scenes.items())
        return f"StudyResult({scenes})"

    def _repr_html_(self) -> str:
        return html_table(f"Study of {self.provenance.date}", summary_rows(self))


def stored_solution(fields: Mapping[str, Any], transducers: int, points: int) -> Solution:
    """Return the solution of stored trials with these `fields`, after checking them.

    Raises:
        ValueError: another shape or type, or numbers out of range; the message names the field.
    """
    drive = validate_drives(fields["drive"], transducers)
    if drive.ndim != 2:
        raise ValueError(f"drive: shape {tuple(drive.shape)}; must be (T, {transducers})")
    trials = len(drive)
    evaluations = np.asarray(fields["evaluations"])
    if evaluations.shape != (trials,) or evaluations.dtype != np.int64 or evaluations.min() < 1:
        raise invalid("evaluations", evaluations, f"must be {trials} integers >= 1")
    history = real_tensor("history", fields["history"])
    shape, most = tuple(history.shape), int(evaluations.max())
    if history.ndim != 2 or shape[0] != trials or shape[1] < most or (history.diff() < 0).any():
        accepted = f"must be ({trials}, {most}) or longer, no number below the one before"
        raise ValueError(f"history: shape {shape}; {accepted}")
    score, best = stored_numbers("score", fields["score"], trials, least=-math.inf), history[:, -1]
    if (score > best + NEAR_TIE * best.abs()).any():  # below it is the last drive, of `identify`
        raise invalid("score", score, f"must be at most {best.tolist()}, the best of the history")
    pressure = stored_numbers("pressure", fields["pressure"], trials, points)
    return Solution(drive, pressure, score, torch.from_numpy(evaluations), history)


def stored_numbers(name: str, value: object, *shape: int, least: float = 0.0) -> torch.Tensor:
    """Return finite numbers of a shape and >= `least`, after checking them."""
    numbers = real_tensor(name, value)
    if numbers.shape != shape:
        raise ValueError(f"{name}: shape {tuple(numbers.shape)}; must be {shape}")
    if numbers.min() < least:
        raise invalid(name, numbers, f"every number must be >= {least:g}")
    return numbers


def median_trial(score: torch.Tensor) -> int:
    """Return the index of the median of `score` (T,); of two middle ones, of the lower."""
    return int(score.argsort(stable=True)[(len(score) - 1) // 2])


def with_prefixes(results: StudyResult) -> StudyResult:
    """Return results to be shown: forces and stiffnesses in mN, µN or nN, by the largest of the study."""
    scenes = dict(results.scenes)
    for unit in _NEWTONS:
        of_unit = {name: scene for name, scene in scenes.items() if scene.unit == unit}
        scores = [method.solution.score for scene in of_unit.values() for method in scene.methods.values()]
        scale = prefixed(max((float(score.abs().max()) for score in scores), default=0.0), unit)
        scenes |= {name: _scaled(scene, *scale) for name, scene in of_unit.items()}
    return replace(results, scenes=scenes)


def _scaled(scene: SceneResult, factor: float, unit: str) -> SceneResult:
    """Return a scene with its scores times a factor, in another unit."""
    methods = {}
    for name, method in scene.methods.items():
        solution = method.solution
        scores = {"score": factor * solution.score, "history": factor * solution.history}
        methods[name] = replace(method, solution=replace(solution, **scores))
    return replace(scene, bound=factor * scene.bound, methods=methods, unit=unit)


def summary_rows(results: StudyResult) -> list[list[str]]:
    """Return a table of the metrics, header first: mean over the trials ± standard deviation.

    The score has a column where it is not the pressure of the weakest focus, as in the paper; studies of
    forces alone have no columns of pressures. The last column has the mean score over the bound of the scene.
    The numbers of a column have equal decimals.
    """
    results = with_prefixes(results)
    scored = any(scene.goal != PAPERS_GOAL for scene in results.scenes.values())
    head = ["scene", "method", "trials", *(["score"] if scored else [])]
    columns = ["mean [Pa]", "weakest [Pa]", "std [Pa]", "area [mm²]"] if with_foci(results) else []
    rows = [[*head, *columns, "evaluations", "of the bound"]]
    scores = column_decimals(results, lambda method: method.solution.score)
    pressures = column_decimals(results, lambda method: method.of_foci("mean"))
    areas = column_decimals(results, area_of)
    for scene_name, scene in results.scenes.items():
        for name, method in scene.methods.items():
            score = [scene.in_unit(_over_trials(method.solution.score, scores))] if scored else []
            numbers = ["-"] * len(columns)
            if (metrics := method.metrics) is not None:
                of_foci = metrics.mean, metrics.min, metrics.std
                area = area_of(method)
                numbers = [_over_trials(values, pressures) for values in of_foci]
                numbers.append("none" if area is None else _over_trials(area, areas))
            evaluations = f"{method.solution.evaluations.double().mean():.0f}"
            share = _share_of_bound(scene, float(method.solution.score.mean()))
            rows.append(
                [scene_name, label_of(name), str(method.trials), *score, *numbers, evaluations, share]
            )
    return rows


def column_decimals(results: StudyResult, quantity: Callable[[MethodResult], torch.Tensor | None]) -> int:
    """Return decimals for a column of a table: the largest value of each scene has three digits or more."""
    decimals = [0]
    for scene in results.scenes.values():
        values = [value for method in scene.methods.values() if (value := quantity(method)) is not None]
        decimals.append(decimals_of(float(value.abs().max()) for value in values))
    return max(decimals)


def _share_of_bound(scene: SceneResult, score: float) -> str:
    """Return the share of a score in the bound of its scene, and the bound, as far as there are such."""
    if not math.isfinite(scene.bound):
        return "no bound known"
    bound = scene.in_unit(f"{scene.bound:.4g}")
    if scene.bound <= 0:
        return f"no drive above {bound} (certified)"
    if score <= 0:  # a stiffness below 0 is no trap
        return f"{'below 0' if score < 0 else '0'} % of {bound}"
    return f"{in_percent(score / scene.bound)} % of {bound}"


def with_foci(results: StudyResult) -> bool:
    """Return whether any result has figures of merit of foci, and not forces alone."""
    return any(scene.of_pressures for scene in results.scenes.values())


def area_of(method: MethodResult) -> torch.Tensor | None:
    """Return the area a focus of each trial (T,) [mm^2], if it is known."""
    area = method.of_foci("area")
    return None if area is None else 1e6 * area


def _over_trials(values: torch.Tensor, decimals: int) -> str:
    mean = f"{values.mean():.{decimals}f}"
    return mean if len(values) == 1 else f"{mean} ± {values.std():.{decimals}f}"
