"""Trials x scenes x methods; finished trials are saved one by one, and not computed again."""

from __future__ import annotations

import functools
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from autdtorch.io.goal_section import goal_section
from autdtorch.methods.base import Method
from autdtorch.methods.solution import Solution
from autdtorch.objectives.forces import ForceGoal, ForceObjective, Push
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.objectives.metrics import FocusMetrics, focus_metrics
from autdtorch.objectives.over_scenes import OverScenes
from autdtorch.objectives.scenarios import observed_goal
from autdtorch.propagators import Propagator, SimulatedPropagator, TMatrixPropagator, make_propagator
from autdtorch.propagators.plan import plan
from autdtorch.propagators.tmatrix.propagator import placed_bodies
from autdtorch.scene.obstacles.moving import is_movable
from autdtorch.scene.scene import Scene
from autdtorch.study.folder import TrialFile, open_folder
from autdtorch.study.results import (
    MethodResult,
    SceneResult,
    SceneSimulation,
    StudyResult,
    median_trial,
    provenance_now,
)
from autdtorch.study.study_method import (
    StudyMethod,
    blank_problem,
    check_goal,
    code_of,
    counts_of,
    goals_of,
    method_for_bodies,
    objective_of,
    scenes_of,
    solve,
)
from autdtorch.utils.files import require_name
from autdtorch.utils.progress import Progress, show_progress
from autdtorch.utils.spatial import nearest
from autdtorch.utils.text import counted
from autdtorch.utils.validation import LENGTH_TOLERANCE, invalid, positive, within

logger = logging.getLogger(__name__)


BLOCK = Method.block
"""Trials that are run and saved together: a process that ends loses one block at most."""

_COUNTED_SPACING = 2e-3  # [m], of the grid on which the runs of poses are counted, at most
_MOST_BODIES = 4  # bodies whose T-matrices stay in memory

_MOST_SAMPLES = 10**6  # of an observation plane: 16 complex columns of them are 256 MB


def run_study(
    scenes: Mapping[str, Scene],
    methods: Mapping[str, StudyMethod],
    folder: Path,
    *,
    solver: Mapping[str, Any] | None = None,
    trials: int | Mapping[str, int] = 1,
    seed: int = 0,
    plane_spacing: float = 1e-3,
    goal: Goal | ForceGoal = WEAKEST_FOCUS,
    config: str = "",
    poses: bool = False,
    scenarios: Mapping[str, Any] | None = None,
) -> StudyResult:
    """Run every method in every scene; return the results of all scenes.

    A scene is simulated twice, whatever the number of methods and trials: its transfer matrix, on which the
    methods work, and then the observation plane under their drives. All settings are checked before.

    Args:
        scenes: by name.
        methods: by name, such as ``GABS(levels=16)``.
        folder: where trials are saved as they end, and scenes when they are finished.
        solver: arguments of `make_propagator`.
        trials: of every method that has random choices, or by method name.
        seed: of the random choices, >= 0; the same in every scene.
        plane_spacing: edge of a cell of the observation plane [m].
        goal: what the methods maximise. For a force, methods see the readings of a `ForceObjective`; a `Push`
            takes T-matrices, if the solver's method is left open.
        config: all of the above as text. What the folder holds for the same text, made with the same source
            and packages, is taken from there. Without text, or with methods, obstacles or a goal that are not
            autdtorch's, everything is computed.
        poses: whether the scenes are poses of the obstacles, in order. Methods start at the drives of
            the scene before, and the method "auto" of the solver takes T-matrices where these are
            fewer simulations in all.
        scenarios: arguments of `Scenarios.around`: each scene stands for itself and variants of it, and
            scores, pressures and bounds are those of all. Observation planes show the scene itself.

    Raises:
        ValueError: an argument out of range, a solver's and a method's included, or another process writes
            into the folder.
        OSError: the folder cannot be written.
    """
    for field, named in (("scenes", scenes), ("methods", methods)):
        if not named:
            raise ValueError(f"{field}: empty; must have at least one")
        for name in named:
            require_name(field, name)
    counts = counts_of(methods, trials, seed)
    plane_spacing = positive("plane_spacing", plane_spacing, "m")
    check_goal(goal, scenes, methods)
    copies = scenes_of(scenarios, goal)
    counted_copies = copies.scenes if isinstance(copies, OverScenes) else None
    for name, method in methods.items():
        for scene in scenes.values():
            if isinstance(method, Method):
                problem = blank_problem(scene, copies)
                with within(f"method {name}"):
                    method.require_fit(problem, min(counts[name], method.block))
    planes = {name: _plane_points(scene, plane_spacing) for name, scene in scenes.items()}
    # The digest of our source does not cover methods, obstacles and goals of users.
    code = [*map(code_of, methods.values()), *map(type, goals_of(goal))]
    code += [type(obstacle) for scene in scenes.values() for obstacle in scene.obstacles]
    ours = all(kind.__module__.partition(".")[0] == "autdtorch" for kind in code)
    provenance = provenance_now(config, seed)
    with open_folder(folder, provenance, scenes, counted_copies, reuse=bool(config) and ours) as stored:
        missing = {name: scene for name, scene in scenes.items() if name not in stored.scenes}
        with within("solver"):
            settings = _for_poses(scenes, solver or {}) if poses else solver or {}
            if isinstance(goal, Push):
                settings = {**settings, "method": method_for_bodies(settings)}
            propagators = {name: make_propagator(scene, **settings) for name, scene in missing.items()}
        stored.begin()
        names = list(scenes)
        left = functools.partial(stored.seconds_left, counts)
        with show_progress(len(missing) * (sum(counts.values()) + 2), left=left) as progress:
            for name in missing:
                propagator = propagators.pop(name)
                first = not poses or name == names[0]
                before = None if first else stored.scenes[names[names.index(name) - 1]]
                place = name, propagator, scenarios, planes[name]
                finished = _run_scene(*place, methods, counts, seed, goal, stored.trials, progress, before)
                stored.save(name, finished)
                level = logging.DEBUG if poses else logging.INFO
                logger.log(level, "%s: %s", name, _in_short(propagator, finished))
        if poses and missing:
            logger.info("%s, the last: %s", counted(len(missing), "pose"), _in_short(propagator, finished))
        return StudyResult(stored.provenance, {name: stored.scenes[name] for name in scenes})


def _for_poses(scenes: Mapping[str, Scene], solver: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `make_propagator` for poses of obstacles: T-matrices where they pay.

    Runs are counted on a coarse grid, those of the boxes at the first pose.
    """
    first = next(iter(scenes.values()))
    settings = {key: solver[key] for key in ("tolerance",) if key in solver}
    spacing = min(_COUNTED_SPACING, solver.get("spacing") or math.inf, plan(first, spacing=None).spacing)
    each = make_propagator(first, spacing=spacing, **settings)
    if solver.get("method", "auto") != "auto" or not isinstance(each, SimulatedPropagator):
        return dict(solver)
    if each.method != "box" or not all(map(is_movable, first.obstacles)):
        return dict(solver)
    bodies = {}
    for scene in scenes.values():
        once = plan(scene, "tmatrix", spacing, **settings)
        if not TMatrixPropagator(once).serves(scene.control_points).all():
            return dict(solver)
        bodies.update({body.body: body for body in placed_bodies(once)})
        if len(bodies) > _MOST_BODIES:
            return dict(solver)
    runs = sum(body.runs for body in bodies.values())
    if runs > len(scenes) * each.planned_runs:
        return dict(solver)
    logger.debug("T-matrices: %d runs for all poses", runs)
    return {**solver, "method": "tmatrix"}


def _run_scene(
    name: str,
    propagator: Propagator,
    scenarios: Mapping[str, Any] | None,
    plane: torch.Tensor | None,
    methods: Mapping[str, StudyMethod],
    counts: Mapping[str, int],
    seed: int,
    goal: Goal | ForceGoal,
    trials: TrialFile,
    progress: Progress,
    before: SceneResult | None,
) -> SceneResult:
    scene = propagator.scene
    progress.describe(f"{name}: transfer matrix")
    begin = time.perf_counter()
    objective = objective_of(propagator, goal, scenarios)
    goal = objective.goal if isinstance(objective, ForceObjective) else goal
    assert isinstance(goal, Goal)
    transfer_matrix, (maximised, _) = objective.transfer_matrix, observed_goal(objective, goal)
    matrix_seconds = time.perf_counter() - begin
    assert transfer_matrix is not None
    assert isinstance(maximised, Goal)
    progress.advance(1)
    for method_name, method in methods.items():
        where = name, method_name, counts[method_name]
        progress.advance(where[2] - len(trials.missing(*where)))
        size = method.block if isinstance(method, Method) else BLOCK
        start = None if before is None else before.methods[method_name].solution.drive

        def solved(
            trials: range,
            name: str = method_name,
            method: StudyMethod = method,
            start: torch.Tensor | None = start,
        ) -> Solution:
            first_drives = None if start is None else start[list(trials)]
            return solve(method, objective, trials, seed, goal, first_drives, name=name)

        _run_trials(where, size, solved, trials, progress)
    solutions = {
        method_name: trials.solution(name, method_name, count) for method_name, count in counts.items()
    }
    progress.describe(f"{name}: observation plane")
    begin = time.perf_counter()
    planes, cell_area = _plane_pressures(
        propagator, [solution.drive for solution, _ in solutions.values()], plane
    )
    plane_seconds = time.perf_counter() - begin
    progress.advance(1)
    results = {}
    for (method_name, (solution, seconds)), pressure in zip(solutions.items(), planes, strict=True):
        metrics = None
        if goal.of_pressures:
            metrics = _metrics(solution.pressure, pressure, len(scene.control_points), cell_area)
        shown = median_trial(solution.score)
        shown_plane = None if pressure is None else pressure[shown].clone()
        results[method_name] = MethodResult(solution, metrics, seconds, shown, shown_plane)
    simulation = _simulation(propagator, matrix_seconds, plane_seconds)
    known = transfer_matrix, float(maximised.bound(transfer_matrix)), simulation, results
    return SceneResult(len(scene.obstacles), *known, goal_section(maximised), goal.unit)


def _metrics(
    pressure: torch.Tensor, plane: torch.Tensor | None, foci: int, cell_area: float | None
) -> FocusMetrics:
    """Return the metrics of pressures (T, P), whose first `foci` are those of the plane."""
    metrics = focus_metrics(pressure)
    if plane is None:
        return metrics
    return replace(metrics, area=focus_metrics(pressure[:, :foci], plane.abs(), cell_area).area)


def _simulation(propagator: Propagator, matrix_seconds: float, plane_seconds: float) -> SceneSimulation:
    """Return the simulation that gave a matrix and the planes in these times [s]."""
    seconds = matrix_seconds, plane_seconds
    if isinstance(propagator, SimulatedPropagator | TMatrixPropagator):
        settings = propagator.spacing, propagator.tolerance, tuple(propagator.runs)
        return SceneSimulation(propagator.method, propagator.scene.wavelength, *settings, *seconds)
    return SceneSimulation("free_space", propagator.scene.wavelength, None, None, (), *seconds)


def _run_trials(
    where: tuple[str, str, int],
    size: int,
    solve: Callable[..., Solution],
    trials: TrialFile,
    progress: Progress,
) -> None:
    """Run the blocks of `size` trials of which one is missing; `where` is scene, method and their number."""
    scene, method, count = where
    missing = set(trials.missing(*where))
    for block in (range(first, min(first + size, count)) for first in range(0, count, size)):
        if missing.isdisjoint(block):
            continue
        first, last = block[0] + 1, block[-1] + 1
        numbers = f"trial {first}" if first == last else f"trials {first} to {last}"
        progress.describe(f"{scene}: {method}, {numbers} of {count}")
        begin = time.perf_counter()
        solution = solve(trials=block)
        seconds = time.perf_counter() - begin
        trials.append(scene, method, block, solution, seconds)
        progress.advance(len(missing.intersection(block)))


def _in_short(propagator: Propagator, result: SceneResult) -> str:
    """Return the work of a scene in a line: how it was simulated, the error that is known, and the trials."""
    simulation = result.simulation
    work = "free space" if simulation.method == "free_space" else f"{simulation.method}, "
    if isinstance(propagator, SimulatedPropagator | TMatrixPropagator):
        work += _accuracy(propagator, simulation)
        if propagator.cells:
            work += f", {propagator.cells:,} cells of {1e3 * propagator.spacing:.3g} mm"
    if isinstance(propagator, SimulatedPropagator) and propagator.loaded_from is not None:
        work += f", the matrix of an earlier run, kept in {propagator.loaded_from}"
    parts = [f"{work}, {simulation.matrix_seconds + simulation.plane_seconds:.1f} s"]
    for name, method in result.methods.items():
        trials = counted(method.trials, "trial")
        parts.append(f"{name}, {trials}, {float(method.seconds.sum()):.1f} s")
    return "; ".join(parts)


def _accuracy(propagator: SimulatedPropagator | TMatrixPropagator, simulation: SceneSimulation) -> str:
    """Return the number of simulations, and the relative error as far as it is known."""
    if isinstance(propagator, TMatrixPropagator):
        waves = f"{propagator.planned_runs} waves" if propagator.cells else "exact waves"
        return f"{waves}, within {propagator.tolerance:g}"
    count, error = len(simulation.runs), propagator.known_error
    runs = counted(count, "run")
    if math.isfinite(error):
        return f"{runs}, estimated error {error:.1g}"
    return f"{runs}, within {max((run.remaining for run in simulation.runs), default=0.0):.1g} of steady"


def _plane_points(scene: Scene, spacing: float) -> torch.Tensor | None:
    """Samples (Nu, Nv, 3) [m] of the observation plane, fit to be simulated."""
    plane = scene.observation_plane
    if plane is None:
        return None
    if spacing > min(plane.size):
        accepted = f"must be at most {min(plane.size):g} m, the plane's edge"
        raise invalid("plane_spacing", spacing, accepted, "m")
    count = math.prod(max(1, round(length / spacing)) for length in plane.size)
    if count > _MOST_SAMPLES:
        accepted = f"gives {count} samples of the observation plane, must be at most {_MOST_SAMPLES}"
        raise invalid("plane_spacing", spacing, accepted, "m")
    points = plane.points(spacing)
    gap, transducers = nearest(points.reshape(-1, 3), scene.array.positions)
    if gap.min() < LENGTH_TOLERANCE:
        transducer = int(transducers[gap.argmin()])
        accepted = f"puts a sample of the observation plane on transducer {transducer}; shift the plane"
        raise invalid("plane_spacing", spacing, accepted, "m")
    return points


def _plane_pressures(
    propagator: Propagator, drives: list[torch.Tensor], points: torch.Tensor | None
) -> tuple[Sequence[torch.Tensor | None], float | None]:
    """Pressure (T, Nu, Nv) [Pa] on the observation plane by method, and the area of a cell [m^2]."""
    plane = propagator.scene.observation_plane
    if plane is None or points is None:
        return [None] * len(drives), None
    # All drives in one call: the propagator then needs no more than one simulation a transducer.
    pressure = propagator.field(torch.cat(drives), points).cpu()
    area = plane.size[0] * plane.size[1] / points[..., 0].numel()
    return torch.split(pressure, [len(drive) for drive in drives]), area
