"""Trials x scenes x methods, one after the other; what is finished is kept on disk and not computed again."""

from __future__ import annotations

import contextlib
import functools
import inspect
import logging
import math
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import torch
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from autdtorch.metrics import focus_metrics
from autdtorch.objective import Objective, SimulatedObjective
from autdtorch.optim.base import Solution
from autdtorch.propagator import Propagator, SimulatedPropagator, make_propagator
from autdtorch.results import (
    RESULTS_FILE,
    MethodResult,
    Provenance,
    SceneResult,
    Simulation,
    StudyResult,
    load_results,
    provenance_now,
    save_results,
    set_aside,
)
from autdtorch.scene import Scene
from autdtorch.validation import LENGTH_TOLERANCE, distances, integer_at_least, invalid, positive

logger = logging.getLogger(__name__)

#: An optimiser with its settings bound. It gets `trials` and `seed` where it has such parameters.
Method: TypeAlias = Callable[..., Solution]

_LARGEST_SEED = 2**63 - 1  # the largest integer that a results file holds
_MOST_SAMPLES = 10**6  # of an observation plane: 16 complex columns of them are 256 MB

_NAME = re.compile(r"[\w.+-]+")  # of scenes and methods: they become names of files and of groups in them


def run_study(
    scenes: Mapping[str, Scene],
    methods: Mapping[str, Method],
    *,
    solver: Mapping[str, Any] | None = None,
    trials: int | Mapping[str, int] = 1,
    seed: int = 0,
    plane_spacing: float = 1e-3,
    folder: str | os.PathLike[str] | None = None,
    config: str = "",
) -> StudyResult:
    """Run every method in every scene.

    A scene is simulated twice, whatever the number of methods and trials: its transfer matrix, on which the
    methods work, and then the observation plane under the drives they found. All settings are checked before.

    Args:
        scenes: by name.
        methods: by name, such as ``functools.partial(gabs, levels=16)``.
        solver: arguments of `make_propagator`.
        trials: of every method that has random choices, or by method name.
        seed: of the random choices, >= 0; the same in every scene.
        plane_spacing: edge of a cell of the observation plane [m].
        folder: where results are saved after every scene; None to save nothing.
        config: all of the above as text. A scene that the folder holds for the same text, made with the same
            source and packages, is taken from there. Without text, everything is computed.

    Returns:
        The results of all scenes.

    Raises:
        ValueError: an argument out of range, a solver's and a method's included.
        OSError: the folder cannot be written.
    """
    counts = _check(scenes, methods, trials, seed)
    plane_spacing = positive("plane_spacing", plane_spacing, "m")
    for name, method in methods.items():
        for scene in scenes.values():
            _check_method(name, method, scene, counts[name], seed)
    planes = {name: _plane_points(scene, plane_spacing) for name, scene in scenes.items()}
    if any(_function(method).__module__.partition(".")[0] != "autdtorch" for method in methods.values()):
        config = ""  # the digest of our source says nothing of theirs: nothing is re-used
    stored = _stored(folder, provenance_now(config, seed))
    provenance, finished = stored.provenance, dict(stored.scenes)
    missing = {name: scene for name, scene in scenes.items() if name not in finished}
    propagators = {name: _propagator(scene, solver or {}) for name, scene in missing.items()}

    with _progress(len(missing) * (len(methods) + 2)) as step:
        for scene_name in missing:
            propagator = propagators.pop(scene_name)
            finished[scene_name] = _run_scene(
                scene_name, propagator, methods, counts, seed, planes[scene_name], step
            )
            results = StudyResult(provenance, {name: finished[name] for name in scenes if name in finished})
            if folder is not None:
                save_results(results, folder)
    return StudyResult(provenance, {name: finished[name] for name in scenes})


def _check(
    scenes: Mapping[str, Scene], methods: Mapping[str, Method], trials: int | Mapping[str, int], seed: int
) -> dict[str, int]:
    """Check names and counts; returns the number of trials of each method."""
    for field, named in (("scenes", scenes), ("methods", methods)):
        if not named:
            raise ValueError(f"{field}: empty; must have at least one")
        for name in named:
            if not _NAME.fullmatch(name):
                raise invalid(field, name, "a name must consist of letters, digits and _ . + -")
    if integer_at_least("seed", seed, 0) > _LARGEST_SEED:
        raise invalid("seed", seed, f"must be an integer from 0 to {_LARGEST_SEED}")
    random = [name for name, method in methods.items() if "trials" in inspect.signature(method).parameters]
    if not isinstance(trials, Mapping):
        count = integer_at_least("trials", trials, 1)
        trials = dict.fromkeys(random, count)
    for name in trials:
        if name not in random:
            accepted = f"must be a method with random choices: {', '.join(random) or 'none'}"
            raise invalid("trials", name, accepted)
    if absent := [name for name in random if name not in trials]:
        raise invalid("trials", dict(trials), f"must also give the number for {', '.join(absent)}")
    return {name: integer_at_least(f"trials.{name}", trials.get(name, 1), 1) for name in methods}


def _propagator(scene: Scene, solver: Mapping[str, Any]) -> Propagator:
    try:
        return make_propagator(scene, **solver)
    except ValueError as error:
        raise ValueError(f"solver: {error}") from error


class _FirstEvaluationError(Exception):
    """Ends a method that has come as far as its first evaluation."""


class _Probe:
    """An objective that ends the method instead of observing anything."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.evaluations = 0

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        raise _FirstEvaluationError


def _check_method(name: str, method: Method, scene: Scene, trials: int, seed: int) -> None:
    """Have the method check its settings now, not after minutes of simulation."""
    try:
        _solve(method, _Probe(scene), trials, seed)
    except _FirstEvaluationError:
        pass
    except ValueError as error:
        raise ValueError(f"method {name}: {error}") from error


def _function(method: Method) -> Callable[..., Any]:
    return method.func if isinstance(method, functools.partial) else method


def _solve(method: Method, objective: Objective, trials: int, seed: int) -> Solution:
    parameters = inspect.signature(method).parameters
    given = {"trials": trials, "seed": seed}
    return method(objective, **{key: value for key, value in given.items() if key in parameters})


def _stored(folder: str | os.PathLike[str] | None, provenance: Provenance) -> StudyResult:
    """What the folder holds of the same study; nothing where it holds another one, or none."""
    nothing = StudyResult(provenance, {})
    if folder is None or not provenance.config:
        return nothing
    path = Path(folder) / RESULTS_FILE
    if not path.exists():
        return nothing
    try:
        stored = load_results(path)
    except ValueError as error:
        logger.warning("computing everything again: %s", error)
        set_aside(folder)
        return nothing
    if not stored.provenance.same_origin(provenance):
        logger.warning("%s is of other settings, source or packages: kept as previous-%s", path, path.name)
        set_aside(folder)
        return nothing
    logger.info("re-using %s from %s, same settings and same source", ", ".join(stored.scenes), path)
    return stored


def _run_scene(
    scene_name: str,
    propagator: Propagator,
    methods: Mapping[str, Method],
    counts: Mapping[str, int],
    seed: int,
    plane: torch.Tensor | None,
    step: Callable[[str], None],
) -> SceneResult:
    scene = propagator.scene
    step(f"{scene_name}: transfer matrix")
    begin = time.perf_counter()
    objective = SimulatedObjective(scene, propagator)
    transfer_matrix = propagator.transfer_matrix().cpu()
    matrix_seconds = time.perf_counter() - begin
    solutions, seconds = {}, {}
    for name, method in methods.items():
        step(f"{scene_name}: {name}, {counts[name]} trials")
        begin = time.perf_counter()
        solutions[name] = _solve(method, objective, counts[name], seed)
        seconds[name] = time.perf_counter() - begin
    step(f"{scene_name}: observation plane")
    begin = time.perf_counter()
    planes, cell_area = _plane_pressures(propagator, solutions, plane)
    plane_seconds = time.perf_counter() - begin
    results = {
        name: _method_result(solution, planes.get(name), cell_area, seconds[name])
        for name, solution in solutions.items()
    }
    simulation = _simulation(propagator, matrix_seconds, plane_seconds)
    return SceneResult(len(scene.obstacles), transfer_matrix, None, simulation, results)


def _plane_points(scene: Scene, spacing: float) -> torch.Tensor | None:
    """Samples (Nu, Nv, 3) [m] of the observation plane, fit to be simulated."""
    plane = scene.observation_plane
    if plane is None:
        return None
    count = math.prod(max(1, round(length / spacing)) for length in plane.size)
    if count > _MOST_SAMPLES:
        accepted = f"gives {count} samples of the observation plane, must be at most {_MOST_SAMPLES}"
        raise invalid("plane_spacing", spacing, accepted, "m")
    points = plane.points(spacing)
    gap = distances(points.reshape(-1, 3), scene.array.positions)
    if gap.min() < LENGTH_TOLERANCE:
        transducer = int(gap.argmin()) % len(scene.array)
        accepted = f"puts a sample of the observation plane on transducer {transducer}; shift the plane"
        raise invalid("plane_spacing", spacing, accepted, "m")
    return points


def _plane_pressures(
    propagator: Propagator, solutions: Mapping[str, Solution], points: torch.Tensor | None
) -> tuple[dict[str, torch.Tensor], float | None]:
    """Pressure (T, Nu, Nv) [Pa] on the observation plane by method, and the area of a cell [m^2]."""
    plane = propagator.scene.observation_plane
    if plane is None or points is None:
        return {}, None
    # All drives in one call: the propagator then needs no more than one simulation a transducer.
    drives = torch.cat([solution.drive for solution in solutions.values()])
    pressure = propagator.field(drives, points.reshape(-1, 3)).cpu().reshape(-1, *points.shape[:2])
    parts = torch.split(pressure, [len(solution.drive) for solution in solutions.values()])
    return dict(zip(solutions, parts, strict=True)), plane.size[0] * plane.size[1] / points[..., 0].numel()


def _method_result(
    solution: Solution, plane: torch.Tensor | None, cell_area: float | None, seconds: float
) -> MethodResult:
    metrics = focus_metrics(solution.pressure, None if plane is None else plane.abs(), cell_area)
    shown = int(solution.score.argsort(stable=True)[(len(solution.score) - 1) // 2])
    shares = torch.full((len(solution.score),), seconds / len(solution.score), dtype=torch.float64)
    return MethodResult(solution, metrics, shares, shown, None if plane is None else plane[shown].clone())


def _simulation(propagator: Propagator, matrix_seconds: float, plane_seconds: float) -> Simulation:
    wavelength = propagator.scene.wavelength
    if isinstance(propagator, SimulatedPropagator):
        spacing, tolerance, runs = propagator.spacing, propagator.tolerance, tuple(propagator.runs)
        return Simulation(
            propagator.method, wavelength, spacing, tolerance, runs, matrix_seconds, plane_seconds
        )
    return Simulation("free_space", wavelength, None, None, (), matrix_seconds, plane_seconds)


@contextlib.contextmanager
def _progress(steps: int) -> Iterator[Callable[[str], None]]:
    """A bar on a terminal, beside the log; elsewhere the log alone."""
    if not sys.stderr.isatty():
        yield logger.info
        return
    with logging_redirect_tqdm(), tqdm(total=steps, file=sys.stderr, dynamic_ncols=True) as bar:

        def step(what: str) -> None:
            if bar.desc:
                bar.update()
            bar.set_description(what)

        yield step
        bar.update()
